"""Configure the site that ``make docs`` builds from the pages in docs/, CONTRIBUTING.md, CHANGELOG.md and bench/.

The source folder is the repository's root, so the same relative links work in the repository and on the site.
The build replaces comments ``<!-- KIND: words -->`` by generated text. ``PLACES`` lists the kinds.
"""

import logging
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from jupyter_client.manager import KernelManager
from sphinx.addnodes import pending_xref

sys.path.insert(0, str(Path(__file__).parent))
import reference

import lyceum_warp as lw

for each in ("lyceum_warp", "traitlets"):
    logging.getLogger(each).setLevel(logging.WARNING)
sys.modules["lw"] = lw  # the reference shows names as users write them: lw.make

project, version, author = "lyceum_warp", lw.__version__, "The lyceum_warp authors"
extensions = ["myst_nb", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = ["docs/**", "CONTRIBUTING.md", "CHANGELOG.md", "bench/README.md", "bench/results/*.md"]
exclude_patterns = [".*", "build", "runs", "**/__pycache__"]

html_theme, html_title = "furo", "lyceum_warp"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"sidebar_hide_name": False, "navigation_with_keys": True}
html_show_copyright = html_show_sourcelink = False

highlight_language = "none"  # blocks without a language are output and formulas
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode, nb_execution_raise_on_error = "force", True
nb_execution_timeout = 900  # time limit of a cell in seconds; compiling kernels may take minutes
nb_merge_streams = nb_execution_in_temp = True
KernelManager.transport_encryption.default_value = "auto"  # with any other value, Jupyter kernels print a warning

add_module_names, python_use_unqualified_type_names, python_maximum_signature_line_length = True, True, 100
autodoc_member_order, autodoc_typehints = "bysource", "none"

CONTENTS = {
    "Guide": "notebooks/first_task own_task warp_for_python task_form terms scope",
    "Tasks": "gallery tasks/gymnasium tasks/dm_control tasks/adroit tasks/control tasks/arms tasks/balance "
    "tasks/velocity velocity terrain tasks/tracking tracking dm_suite",
    "Learning": "runs many_runs clusters ppo sac memory pixels policies learners deployment fitting adapters "
    "notebooks/own_robot notebooks/deploy",
    "Planning": "planning notebooks/live_planner",
    "Viewer": "viewer",
    "Internals": "architecture physics Measurements</bench/README> /CONTRIBUTING /CHANGELOG",
    "Reference": "reference/environments reference/tasks reference/functions reference/models reference/learning "
    "reference/planning reference/runs",
}
"""The pages of each section in order, as paths relative to docs/."""


def contents(_: str) -> str:
    """Return the contents of the sidebar."""
    return "\n".join(
        "\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", *pages.split(), "```", ""])
        for caption, pages in CONTENTS.items()
    )


PLACES = {"contents": contents, "names": reference.names, "modules": reference.modules, "tasks": reference.tasks}


def fill(app: Any, docname: str, source: list[str]) -> None:
    """Replace the comments in a page by generated text."""
    if docname == "bench/README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\nresults/*\n```\n"
    if docname.startswith("docs/") and not docname.startswith("docs/notebooks/"):
        kinds = "|".join(PLACES)
        source[0] = re.sub(
            rf"<!-- ({kinds}):? ?(.*?)-->", lambda match: PLACES[match[1]](match[2]), source[0], flags=re.DOTALL
        )


def link_names(app: Any, doctree: nodes.document) -> None:
    """Link inline code such as ``lw.make`` to the reference."""
    for literal in list(doctree.findall(nodes.literal)):
        match = re.fullmatch(r"(lw\.\w+)(\(.*\))?", literal.astext())
        if match and not isinstance(literal.parent, nodes.reference | pending_xref):
            link = pending_xref(
                "", refdomain="py", reftype="obj", reftarget=match[1], refdoc=app.env.docname, refwarn=False
            )
            literal.replace_self(link)
            link += literal


def redirect(app: Any, error: Exception | None) -> None:
    """Redirect from the site's address to its first page."""
    Path(app.outdir, "index.html").write_text('<meta http-equiv="refresh" content="0; url=docs/index.html">\n')


def setup(app: Any) -> None:
    """Connect this module's functions to the build."""
    app.connect("source-read", fill)
    app.connect("autodoc-process-docstring", reference.convert)
    app.connect("autodoc-process-signature", reference.short_signature)
    app.connect("doctree-read", link_names)
    app.connect("build-finished", redirect)
