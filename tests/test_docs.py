"""Run the commands and Python blocks of pages, and check links and file names."""

import dataclasses
import json
import re
import runpy
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from conftest import TaskFile
from memory_window import MemoryWindow
from training_runs import TINY

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import package_task_names
from lyceum_warp.training import Run
from lyceum_warp.tuning import search
from lyceum_warp.viewer import show as views
from lyceum_warp.viz import check_video
from lyceum_warp.viz.video import NoVideoError

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs").rglob("*.md"))
WALKTHROUGHS = [page for page in PAGES if "\n```sh\n" in page.read_text()]
"""The pages with commands.

The blocks of a page run in order in one folder. A block with a title is written to a file.
"""
DOCUMENTS = [*PAGES, *ROOT.glob("*.md"), *sorted((ROOT / "bench").rglob("*.md"))]


def name_of(path: Path) -> str:
    return path.relative_to(ROOT / "docs" if path in PAGES else ROOT).as_posix()


def python_of(page: Path) -> str:
    """Return a page's Python code. The line numbers match the page, so that a traceback points into the page."""
    lines, language = [], None
    for line in page.read_text().splitlines():
        if line.startswith("```"):
            language = line.removeprefix("```") if language is None else None
            lines.append("")
        else:
            lines.append(line if language == "python" else "")
    return "\n".join(lines) + "\n"


PROGRAMS = [page for page in PAGES if page not in WALKTHROUGHS and python_of(page).strip()]


# other tests cover the program of terrain.md
@pytest.mark.quick(*(name_of(page) for page in PROGRAMS if page.stem != "terrain"))
@pytest.mark.parametrize("page", PROGRAMS, ids=name_of)
def test_python_blocks_of_a_page_run_in_order(page: Path, task_file: TaskFile) -> None:
    if page.stem == "dm_suite":
        pytest.importorskip("dm_control", reason="dm_control brings the models")
    # Warp compiles functions only from a source file
    runpy.run_path(str(task_file(f"page_{page.stem}.py", python_of(page))), run_name=f"page_{page.stem}")


WRONG = re.compile(r"^```py\n(.*?)^```\n\n```\n(.*?)\n```$", re.MULTILINE | re.DOTALL)
MISTAKES = WRONG.findall((ROOT / "docs" / "warp_for_python.md").read_text())


@pytest.mark.parametrize("number", range(len(MISTAKES)))
def test_mistakes_on_a_page_raise_the_errors_that_the_page_shows(number: int, task_file: TaskFile) -> None:
    function, message = MISTAKES[number]
    task = python_of(ROOT / "docs" / "warp_for_python.md")
    assert task.count("class Measured") == 1
    file = task_file(f"wrong_{number}.py", task.replace("class Measured", f"{function}\n\nclass Measured"))
    with pytest.raises(ValueError, match=re.escape(message)):
        lw.make(file)


BLOCK = re.compile(r"^```(\w+)(?: title=(\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)

QUICK = {
    "check": ["--nworld", "2", "--rule", "reset", "--rule", "restoring"],
    "train": ["--iterations", "2", *TINY, "--no-video"],
    "train --teacher": shlex.split("--iterations 2 --nworld 4 --no-video --hidden 8 --mean-every 1 --mean-episodes 2"),
    "train --demonstrations": shlex.split("--iterations 2 --nworld 4 --no-video --hidden 8 --mean-every 0"),
    "train --algorithm": shlex.split(
        "--iterations 2 --nworld 4 --horizon 32 --no-video --hidden 8 --value-hidden 8 --mean-every 1"
    ),
    "train --network": ["--iterations", "2", "--no-video", *TINY[:4]],
    "train --resume": ["--iterations", "3", "--no-video"],
    "eval": ["--episodes", "2", "--no-video"],
    "tune": ["--nworld", "8", "--episodes", "4"],
    "plan": ["--steps", "3", "--samples", "4", "--no-video"],
}


KINDS = ("--resume", "--network", "--teacher", "--demonstrations", "--algorithm")


class Walkthrough:
    """Run a page's blocks in an empty folder. ``quick`` adds the options of QUICK, and omits slow checks on Warp."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, *, quick: bool) -> None:
        self.folder, self.monkeypatch, self.quick = folder, monkeypatch, quick
        monkeypatch.chdir(folder)
        monkeypatch.syspath_prepend(folder)

    def run(self, page: Path) -> None:
        names: dict[str, Any] = {}
        for i, (language, title, text) in enumerate(BLOCK.findall(page.read_text())):
            if title:
                (self.folder / title).write_text(text)
            elif language == "sh":
                for line in text.splitlines():
                    self.command(shlex.split(line))
            elif language == "python":
                script = self.folder / f"block_{i}.py"
                script.write_text(text)
                names = runpy.run_path(str(script), init_globals=names, run_name=f"block_{i}")

    def command(self, command_line: list[str]) -> None:
        match command_line:
            case ["git", "clone", address]:
                robot = self.folder / Path(address).name / "unitree_go1" / "scene.xml"
                robot.parent.mkdir(parents=True)
                robot.write_text(lw.gymnasium_model("ant.xml").spec().to_xml())
            case ["export", setting]:
                name, _, value = setting.partition("=")
                self.monkeypatch.setenv(name, value.replace("$PWD", str(self.folder)))
            case ["lyceum-warp", command, *options]:
                if self.quick and "warp" in options:
                    return
                kinds = [f"{command} {option}" for option in KINDS if option in options]
                kind = kinds[0] if kinds else command
                own = any(option.endswith(".py:Climber") for option in options)  # has no hyperparameters
                more = QUICK.get(kind, []) if self.quick and not own else []
                assert cli.main([command, *options, *more]) == 0, command_line
            case _:
                pytest.fail(f"this test does not know the command {command_line}")


@pytest.fixture(autouse=True)
def short_views(monkeypatch: pytest.MonkeyPatch) -> None:
    def window(*words: object, **options: object) -> MemoryWindow:
        return MemoryWindow(lambda frame, number: [] if number < 1 else None)

    monkeypatch.setattr(views, "Window", window)


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "SHORT", dataclasses.replace(search.SHORT, repeats=2, block_seconds=0.005, steps=40))


@pytest.fixture
def empty_folder(pytestconfig: pytest.Config, tmp_path: Path) -> Path:
    """Return an empty folder at a constant path, so that Warp reuses compiled kernels."""
    cache = getattr(pytestconfig, "cache", None)
    folder = Path(cache.mkdir("walkthrough")) if cache else tmp_path / "walkthrough"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


@pytest.mark.quick("learners.md", "own_task.md", "ppo.md", "runs.md")
@pytest.mark.parametrize("page", WALKTHROUGHS, ids=name_of)
def test_commands_and_python_blocks_of_a_page_run_in_order(
    page: Path, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Walkthrough(empty_folder, monkeypatch, quick=True).run(page)


@pytest.mark.long
def test_walkthrough_of_a_new_task_trains_a_good_policy(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        check_video()
    except NoVideoError as error:
        pytest.skip(str(error))
    Walkthrough(empty_folder, monkeypatch, quick=False).run(ROOT / "docs" / "own_task.md")
    returns = [row["return_mean"] for row in Run.open(empty_folder / "runs" / "balance").rows()]
    assert returns[-1] > 150 > 50 > returns[0]
    for video in ("balance/video.mp4", "balance/eval.mp4", "near/video.mp4", "plan/video.mp4"):
        assert (empty_folder / "runs" / video).stat().st_size > 10_000


def generated(folder: str, kind: str) -> list[str]:
    """Return the words in the ``<!-- kind: ... -->`` comments of a folder's pages.

    The file docs/conf.py replaces these comments by generated sections.
    """
    pages = sorted((ROOT / "docs" / folder).glob("*.md"))
    return [word for page in pages for word in words_of(page, kind)]


def words_of(page: Path, kind: str) -> list[str]:
    return " ".join(re.findall(rf"<!-- {kind}: (.*?)-->", page.read_text(), re.DOTALL)).split()


def anchors(document: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", document.read_text(), re.MULTILINE) + words_of(document, "tasks")
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_links_of_a_document_point_to_existing_files_and_headings(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = document.parent / file if file else document
        assert target.exists(), f"{document.name} links to {link}"
        assert not anchor or anchor in anchors(target), f"{document.name} links to {link}"


def test_files_named_in_the_architecture_exist() -> None:
    named = set(re.findall(r"`([\w./-]+(?:\.py|\.md|/))`", (ROOT / "docs" / "architecture.md").read_text()))
    assert not [name for name in named if not any((place / name).exists() for place in (ROOT, ROOT / "lyceum_warp"))]


def test_the_reference_has_every_public_name_once() -> None:
    assert sorted(generated("reference", "names")) == sorted({*lw.__all__} - {"terms", "walkers", "clip_tables"})


def test_task_pages_have_every_task_of_the_package_once() -> None:
    assert sorted(generated("tasks", "tasks")) == sorted(package_task_names())


def test_notebooks_install_the_package_and_are_stored_with_outputs() -> None:
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        run = [cell for cell in cells if "skip-execution" not in cell["metadata"].get("tags", ())]
        assert "".join(cells[0]["source"]).startswith("%pip install") and cells[0] not in run, path.name
        assert [cell["execution_count"] for cell in run] == list(range(1, len(run) + 1)), f"run {path.name} again"
        outputs = [output for cell in run for output in cell["outputs"]]
        assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)
        kinds = {kind for output in outputs for kind in output.get("data", ())}
        assert kinds & {"image/png", "image/gif", "text/html"}, f"{path.name} shows nothing"


def test_joints_and_units_of_observations_are_up_to_date() -> None:
    observations = runpy.run_path(str(ROOT / "docs" / "observations.py"))
    stored = json.loads(observations["FILE"].read_text())
    assert set(stored) == set(package_task_names())
    for name in ("hopper", "reacher", "go1_velocity"):
        assert observations["sources"](name) == stored[name], f"run docs/observations.py {name}"
    assert stored["hopper"]["policy"]["0"] == ["rootz", "m"] and stored["reacher"]["policy"]["2"] == ["joint0", ""]


def test_table_of_terms_is_up_to_date() -> None:
    page = (ROOT / "docs" / "terms.md").read_text()
    assert runpy.run_path(str(ROOT / "docs" / "terms_table.py"))["written"](page) == page


GALLERY = str(ROOT / "docs" / "gallery.py")


def test_the_robot_of_the_first_page_loads_quickly(tmp_path: Path) -> None:
    (robot,) = words_of(ROOT / "docs" / "index.md", "robot")
    runpy.run_path(GALLERY)["write_turnable"](robot, tmp_path)
    assert 50_000 < (tmp_path / f"{robot}.html").stat().st_size < 400_000


def test_the_gallery_is_up_to_date() -> None:
    results = json.loads((ROOT / "docs" / "images" / "gallery" / "results.json").read_text())
    assert (ROOT / "docs" / "gallery.md").read_text() == runpy.run_path(GALLERY)["page"](results)
