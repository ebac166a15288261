"""The pages in docs/ run as they stand, and they, the contributors' guide and the project's files name what exists."""

import re
import runpy
from pathlib import Path

import pytest
from conftest import TaskFile

import lyceum_warp as lw

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]


def name_of(path: Path) -> str:
    return path.name


def python_of(page: Path) -> str:
    """The Python blocks of a page in order, each line at its place in the page, so that a traceback names that."""
    lines, language = [], None
    for line in page.read_text().splitlines():
        if line.startswith("```"):
            language = line.removeprefix("```") if language is None else None
            lines.append("")
        else:
            lines.append(line if language == "python" else "")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_of_a_page_runs_in_order(page: Path, task_file: TaskFile) -> None:
    source = python_of(page)
    assert source.strip(), f"{page.name} has no Python"
    # a file, because Warp compiles the source of functions
    runpy.run_path(str(task_file(f"page_{page.stem}.py", source)), run_name=f"page_{page.stem}")


def anchors(document: Path) -> set[str]:
    """The headings of a document, as links name them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_links_of_a_document_lead_to_files_and_headings(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = document.parent / file if file else document
        assert target.exists(), f"{document.name} links to {link}"
        assert not anchor or anchor in anchors(target), f"{document.name} links to {link}"


@pytest.mark.parametrize("document", [ROOT / "docs" / "architecture.md"], ids=name_of)
def test_files_that_a_document_names_exist(document: Path) -> None:
    named = set(re.findall(r"`([\w./-]+(?:\.py|\.md|/))`", document.read_text())) - {"path/to/file.py"}
    places = (ROOT, ROOT / "lyceum_warp")
    assert not sorted(name for name in named if not any((place / name).exists() for place in places))


def test_the_workflow_runs_the_checks_on_every_supported_python() -> None:
    yaml = pytest.importorskip("yaml")
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    job = workflow["jobs"]["check"]
    assert any(step.get("run") == "bash .ci/run" for step in job["steps"])
    classifiers = re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text())
    assert job["strategy"]["matrix"]["python"] == classifiers


@pytest.mark.parametrize("form", sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")), ids=name_of)
def test_issue_forms_have_labelled_fields(form: Path) -> None:
    content = pytest.importorskip("yaml").safe_load(form.read_text())
    assert content["name"] and content["description"]
    fields = [field for field in content["body"] if field["type"] != "markdown"]
    assert fields and all(field["attributes"]["label"] for field in fields)
    assert len({field["id"] for field in fields}) == len(fields)


def test_the_citation_names_this_release_and_the_paper() -> None:
    citation = pytest.importorskip("yaml").safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == lw.__version__
    (paper,) = citation["references"]
    assert paper["title"].startswith("Lyceum") and len(paper["authors"]) == 5
    assert {"type": "other", "value": "arXiv:2001.07343", "description": "The preprint"} in paper["identifiers"]
