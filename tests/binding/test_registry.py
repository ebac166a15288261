import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import tiny_task

import lyceum_warp as lw
from lyceum_warp.binding import registry
from lyceum_warp.binding.registry import file_name, find_task, task_name, task_names

REGISTERED = tiny_task.changed(("class Tiny", "@lw.register\nclass Tiny"))

Load = Callable[[str, str], ModuleType]


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))

    def imported(name: str, source: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, tiny_task.write(tmp_path, source, f"{name}.py"))
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return imported


# names


def test_every_task_of_the_package_is_found_by_its_name() -> None:
    for name in task_names():
        assert task_name(find_task(name)) == name


def test_task_name_with_a_namespace_finds_its_task_and_gives_a_valid_file_name() -> None:
    assert find_task("dm/humanoid_walk") is not find_task("humanoid_walk")
    assert file_name("dm/humanoid_walk") == "dm-humanoid_walk" and file_name("hopper") == "hopper"
    with pytest.raises(ValueError, match="no task 'dm/walker_wlk': did you mean dm/walker_walk"):
        find_task("dm/walker_wlk")


@pytest.mark.parametrize("name", ["hopper.xml", "foo.bar", "./t", ""])
def test_unknown_task_name_raises_an_error(name: str) -> None:
    with pytest.raises(ValueError, match="there is no task"):
        find_task(name)


def test_error_of_a_misspelt_task_name_suggests_similar_names() -> None:
    with pytest.raises(ValueError, match=r"no task 'hoper': did you mean hopper.* .*path/to/file.py"):
        find_task("hoper")


@pytest.mark.parametrize("task", [3, None, lw.Env])
def test_object_that_is_not_a_task_raises_an_error(task: object) -> None:
    with pytest.raises(ValueError, match=r"a task is a name, a file or a subclass of lw\.Task, not "):
        find_task(task)  # type: ignore[arg-type]


# classes and registration


def test_a_registered_class_is_found_by_name(load: Load) -> None:
    module = load("registered_here", REGISTERED.replace("Tiny", "RegisteredHere"))
    assert "registered_here" in task_names()
    assert find_task("registered_here") is module.RegisteredHere


def test_registering_a_name_that_is_already_taken_raises_an_error(load: Load) -> None:
    load("first_taker", "import lyceum_warp as lw\n@lw.register\nclass TakenHere(lw.Task):\n    pass\n")
    with pytest.raises(ValueError, match=r"'taken_here' is taken by first_taker.TakenHere: rename yours"):
        load("second_taker", "import lyceum_warp as lw\n@lw.register\nclass TakenHere(lw.Task):\n    pass\n")
    with pytest.raises(ValueError, match=r"'walker2d' is taken by lyceum_warp.tasks.walker2d.*: rename yours"):
        load("third_taker", "import lyceum_warp as lw\n@lw.register\nclass Walker2d(lw.Task):\n    pass\n")
    assert find_task("walker2d").__module__ == "lyceum_warp.tasks.walker2d"


# files


def test_task_file_is_found_by_string_and_by_path(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, tiny_task.TINY)
    assert find_task(file) is find_task(str(file)) is find_task(f"{file}:Tiny")


def test_error_of_a_missing_task_file_names_the_file() -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no task file 'nowhere/task\.py'"):
        find_task("nowhere/task.py")


def test_file_with_several_tasks_raises_an_error_without_a_task_name(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Other(Tiny):\n    pass\n")
    with pytest.raises(ValueError, match=r"has 2 tasks \(Tiny, Other\): name one of them, as .*tiny.py:Name"):
        find_task(file)
    with pytest.raises(ValueError, match=r"tiny.py has no task 'Arm'; it has Tiny, Other"):
        find_task(f"{file}:Arm")
    assert find_task(f"{file}:Other").__name__ == "Other"


def test_a_file_without_a_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has 0 tasks"):
        find_task(tiny_task.write(tmp_path, "import lyceum_warp\n"))


def test_two_files_may_register_tasks_with_equal_names(tmp_path: Path) -> None:
    files = []
    for folder, skip in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        files.append(tiny_task.write(tmp_path / folder, f"{REGISTERED}    frame_skip = {skip}\n"))
    assert [find_task(file).frame_skip for file in files] == [1, 2]
    assert find_task(files[0]) is not find_task(files[1])
