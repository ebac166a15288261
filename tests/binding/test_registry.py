from pathlib import Path

import pytest
import tiny_task

import lyceum_warp as lw
from lyceum_warp.binding import file_name, find_task, registry, task_name, task_names

REGISTERED = tiny_task.changed(("class Tiny", "@lw.register\nclass Tiny"))

# names


def test_every_task_of_the_package_is_found_by_its_name() -> None:
    for name in task_names():
        assert task_name(find_task(name)) == name


def test_task_name_with_a_namespace_finds_its_task_and_gives_a_valid_file_name() -> None:
    assert find_task("dm/humanoid_walk") is not find_task("humanoid_walk")
    assert file_name("dm/humanoid_walk") == "dm-humanoid_walk" and file_name("hopper") == "hopper"
    with pytest.raises(ValueError, match="no task 'dm/walker_wlk': did you mean dm/walker_walk"):
        find_task("dm/walker_wlk")
    with pytest.raises(ValueError, match="no task 'runs/lost': lyceum-warp tasks lists them"):
        find_task("runs/lost")


@pytest.mark.parametrize("name", ["hopper.xml", "foo.bar", "./t", ""])
def test_unknown_task_name_raises_an_error(name: str) -> None:
    with pytest.raises(ValueError, match="there is no task .*path/to/file.py"):
        find_task(name)


@pytest.mark.parametrize("task", [3, None, lw.Env])
def test_object_that_is_not_a_task_raises_an_error(task: object) -> None:
    with pytest.raises(ValueError, match=r"a task is a name, a file or a subclass of lw\.Task, not "):
        find_task(task)  # type: ignore[arg-type]


def test_registering_a_name_that_is_already_taken_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    lw.register(type("TakenHere", (lw.Task,), {"__module__": "json"}))
    with pytest.raises(ValueError, match=r"'taken_here' is taken by json.TakenHere: rename yours"):
        lw.register(type("TakenHere", (lw.Task,), {"__module__": "csv"}))
    with pytest.raises(ValueError, match=r"'walker2d' is taken by lyceum_warp.tasks.walker2d.*: rename yours"):
        lw.register(type("Walker2d", (lw.Task,), {}))
    assert find_task("walker2d").__module__ == "lyceum_warp.tasks.walker2d"


# files


def test_file_with_several_tasks_raises_an_error_without_a_task_name(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Other(Tiny):\n    pass\n")
    with pytest.raises(ValueError, match=r"has 2 tasks \(Tiny, Other\): name one of them, as .*tiny.py:Name"):
        find_task(file)
    with pytest.raises(ValueError, match=r"tiny.py has no task 'Arm'; it has Tiny, Other"):
        find_task(f"{file}:Arm")
    assert find_task(f"{file}:Other").__name__ == "Other"
    with pytest.raises(ValueError, match="has 0 tasks"):
        find_task(tiny_task.write(tmp_path, "import lyceum_warp\n"))


def test_two_files_may_register_tasks_with_equal_names(tmp_path: Path) -> None:
    files = []
    for folder, skip in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        files.append(tiny_task.write(tmp_path / folder, f"{REGISTERED}    frame_skip = {skip}\n"))
    assert [find_task(file).frame_skip for file in files] == [1, 2]
    assert find_task(files[0]) is not find_task(files[1])
