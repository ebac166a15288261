import importlib.util
import subprocess
import sys

import pytest
from rich.console import Console
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import find_task, task_names
from lyceum_warp.cli import list_tasks


def rows(out: str) -> dict[str, list[str]]:
    table, _, legend = out.partition("\n\n")
    assert legend.startswith("obs, act: ")
    heading, *lines = table.splitlines()
    assert heading.split() == ["task", "obs", "act", "skip", "dt", "horizon", "model"]
    return {line.split()[0]: line.split()[1:] for line in lines if not line.startswith(" ")}


def test_tasks_are_listed_with_their_sizes_and_models(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks"]) == 0
    out = capsys.readouterr().out
    found = rows(out)
    assert sorted(found) == task_names()
    assert max(map(len, out.splitlines())) <= 101
    assert found["hopper"] == ["11", "3", "4", "0.008", "s", "1000", "gymnasium:", "hopper.xml"]
    assert found["adroit_pen"][-2:] == ["gymnasium-robotics", "[hand]"]
    assert "    hop forward on one leg (Gymnasium's Hopper-v5) (physics: fast)" in out.splitlines()


def test_narrow_terminal_lists_models_below_the_numbers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(list_tasks, "console", Console(width=60, highlight=False))
    assert cli.main(["tasks", "adroit"]) == 0
    table = capsys.readouterr().out.partition("\n\n")[0]
    assert max(map(len, table.splitlines())) <= 60
    assert "model: gymnasium-robotics [hand]" in " ".join(table.split())


def test_listed_sizes_equal_the_sizes_of_an_environment(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["tasks", "gymnasium"])
    found = rows(capsys.readouterr().out)
    for name in ("hopper", "humanoid", "pusher"):
        env = lw.make(name)
        sizes = [env.obs_space.size, env.action_space.size, env.options.physics.frame_skip or env.task.frame_skip]
        assert found[name][:4] == list(map(str, [*sizes, f"{env.timestep:g}"]))


@pytest.mark.parametrize(
    ("word", "found", "other"),
    [("walker", "walker2d", "reach"), ("HOP", "hopper", "reach"), ("[hand]", "adroit_pen", "hopper")],
)
def test_search_word_selects_tasks_by_name_description_or_model(
    word: str, found: str, other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["tasks", word]) == 0
    listed = rows(capsys.readouterr().out)
    assert found in listed and other not in listed


def test_search_word_without_matching_tasks_prints_a_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks", "submarine"]) == 2
    refused(capsys, "'submarine'", "lyceum-warp tasks")


def test_a_task_with_a_missing_extra_is_listed_without_its_sizes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if "robotics" in name else find(name, *a))
    assert cli.main(["tasks", "[hand]"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    found = rows(out)
    assert found["adroit_pen"] == ["45", "-", "5", "-", "200", "gymnasium-robotics", "[hand]"]
    lines = out.splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith("adroit_pen"))
    assert lines[row + 1].startswith("    turn a pen in the hand")
    assert lines[row + 2] == "    needs: pip install 'lyceum-warp[hand]'"


@pytest.mark.parametrize(
    ("broken", "shown"),
    [
        (staticmethod(lambda p: {"x": p.missing}), "missing"),
        (staticmethod(lambda p: {"x": {}["far"]}), "KeyError: 'far'"),
        (7, "obs of the task 'hopper' is 7: add the parts of its observation"),
    ],
)
def test_broken_task_is_listed_with_its_error(
    broken: object, shown: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    task = find_task("hopper")
    monkeypatch.setattr(task, "obs", broken)
    monkeypatch.setattr(task, "__doc__", None)
    monkeypatch.setattr(sys.modules[task.__module__], "__doc__", None)
    assert cli.main(["tasks", "hop"]) == 0
    out, error = capsys.readouterr()
    assert error == "" and rows(out)["hopper"][0] == "-"
    assert shown in out and "\n    - (physics: fast)\n" in out


@pytest.mark.long
def test_a_closed_pipe_ends_the_list_quietly() -> None:
    command = f"{sys.executable} -m lyceum_warp.cli tasks hopper | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stderr == ""
