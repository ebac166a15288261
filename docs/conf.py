"""Configure the site that ``make docs`` builds from the pages in docs/, CONTRIBUTING.md, CHANGELOG.md and bench/.

The source folder is the repository's root, so the same relative links work in the repository and on the site.
The build replaces comments ``<!-- KIND: words -->`` by generated text. ``PLACES`` lists the kinds.
"""

import html
import logging
import os
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

from docutils import nodes
from jupyter_client.manager import KernelManager
from sphinx.addnodes import desc, desc_content, pending_xref

sys.path.insert(0, str(Path(__file__).parent))
import gallery
import reference

import lyceum_warp as lw

for each in ("lyceum_warp", "traitlets"):
    logging.getLogger(each).setLevel(logging.WARNING)
sys.modules["lw"] = lw  # the reference shows names as users write them: lw.make

project, version, author = "lyceum_warp", lw.__version__, "The lyceum_warp authors"
copyright = f"{author}, MIT licence"
extensions = ["myst_nb", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = ["docs/**", "CONTRIBUTING.md", "CHANGELOG.md", "bench/README.md", "bench/results/*.md"]
exclude_patterns = [".*", "build", "runs", "**/__pycache__"]

html_theme, html_title = "furo", "lyceum_warp"
html_baseurl = os.environ.get("SITE_URL", "")  # the site's address, for canonical links and the page 404.html
html_static_path, html_favicon = ["static"], "static/favicon.svg"
html_css_files, html_js_files = ["site.css"], [("site.js", {"defer": "defer"})]
templates_path, html_additional_pages = ["templates"], {"404": "404.html"}
html_context = {"site_root": html_baseurl.rstrip("/") + "/"}
html_theme_options = {"sidebar_hide_name": False, "navigation_with_keys": True}
html_show_sourcelink = False

highlight_language = "none"  # blocks without a language are output and formulas
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode, nb_execution_raise_on_error = "force", True
nb_execution_timeout = 900  # time limit of a cell in seconds; compiling kernels may take minutes
nb_merge_streams = nb_execution_in_temp = True
KernelManager.transport_encryption.default_value = "auto"  # with any other value, Jupyter kernels print a warning

add_module_names, python_use_unqualified_type_names, python_maximum_signature_line_length = True, True, 100
autodoc_member_order, autodoc_typehints = "bysource", "description"
autodoc_typehints_description_target = "documented"

MANY_MEMBERS = 8

SENTENCE = " ".join(Path(__file__).with_name("index.md").read_text().split("\n\n")[1].split())
"""What the project is: the first paragraph of the first page."""

CONTENTS = {
    "Guide": "notebooks/first_task own_task warp_for_python task_form terms scope",
    "Tasks": "gallery tasks/gymnasium tasks/dm_control tasks/adroit tasks/hands tasks/control tasks/arms tasks/balance "
    "tasks/velocity velocity terrain objects tasks/tracking tracking dm_suite",
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


def robot(name: str) -> str:
    """Return a turnable robot, and a still picture for those without scripts."""
    picture = '<noscript><style>.robot iframe { display: none }</style><img src="stills/robots.webp" alt=""></noscript>'
    return f'<div class="robot">{reference.frame(name.strip(), "")}{picture}</div>'


PLACES = {
    "contents": contents, "names": reference.names, "modules": reference.modules, "tasks": reference.tasks,
    "turnable": reference.turnable, "robot": robot, "keys": reference.keys,
}  # fmt: skip


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


def fold_members(app: Any, doctree: nodes.document, docname: str) -> None:
    """Fold the members of classes that have many. site.js unfolds those of a link's target."""
    for content in list(doctree.findall(desc_content)):
        members = [child for child in content if isinstance(child, desc)]
        if len(members) >= MANY_MEMBERS:
            fold = f'<details class="members"><summary>{len(members)} members</summary>'
            content.insert(content.index(members[0]), nodes.raw("", fold, format="html"))
            content.insert(content.index(members[-1]) + 1, nodes.raw("", "</details>", format="html"))


def load_late(app: Any, doctree: nodes.document) -> None:
    """Let pictures load when they are near, and animations stand still until site.js replaces the still picture."""
    up = "../" * (app.env.docname.count("/") - 1)
    for image in list(doctree.findall(nodes.image)):
        image["loading"] = "lazy"
        if "images/gallery/" in image["uri"]:
            still = f"{up}stills/{Path(image['uri']).name}"
            before = nodes.raw("", f'<picture><source media="all" srcset="{still}">', format="html")
            image.replace_self([before, image, nodes.raw("", "</picture>", format="html")])


def describe(app: Any, pagename: str, templatename: str, context: dict[str, Any], doctree: Any) -> None:
    """Describe a page to search engines by its first paragraph, and pages without one by the project's sentence."""
    paragraph = next(doctree.findall(nodes.paragraph), None) if doctree else None
    text = html.escape(textwrap.shorten(paragraph.astext() if paragraph else SENTENCE, 160, placeholder=" …"))
    context["metatags"] = f'{context.get("metatags", "")}<meta name="description" content="{text}">'


def write_files(app: Any, error: Exception | None) -> None:
    """Write turnable robots and still pictures, and redirect from the site's address to its first page."""
    if error or app.builder.format != "html":
        return
    Path(app.outdir, "index.html").write_text(
        '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url=docs/index.html">\n'
        f'<title>{project}</title><link rel="icon" href="_static/favicon.svg">\n'
        f'<meta name="description" content="{html.escape(SENTENCE)}">\n'
    )
    pages, stills = (Path(app.outdir, "docs", name) for name in ("turnable", "stills"))
    for folder in (pages, stills):
        folder.mkdir(exist_ok=True)
    for name in gallery.turnable_tasks():
        gallery.write_turnable(name, pages)
    for animation in [gallery.DOCS / "images" / "robots.webp", *gallery.FOLDER.glob("*.webp")]:
        gallery.write_still(animation, stills)


def setup(app: Any) -> None:
    """Connect this module's functions to the build."""
    app.connect("source-read", fill)
    app.connect("autodoc-process-docstring", reference.convert)
    app.connect("autodoc-process-signature", reference.short_signature)
    app.connect("doctree-read", link_names)
    app.connect("doctree-read", load_late)
    app.connect("doctree-resolved", fold_members)
    app.connect("html-page-context", describe)
    app.connect("build-finished", write_files)
