import importlib.util
import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import package_task_names
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
    tasks = rows(out)
    assert list(tasks) == sorted(package_task_names())
    assert max(map(len, out.splitlines())) <= 101
    assert tasks["hopper"] == ["11", "3", "4", "0.008", "s", "1000", "gymnasium:", "hopper.xml"]
    assert tasks["adroit_pen"][-2:] == ["gymnasium-robotics", "[hand]"]
    assert "    hop forward on one leg (Gymnasium's Hopper-v5) (physics: fast)" in out.splitlines()


def test_the_stored_list_agrees_with_the_tasks() -> None:
    """If it does not: python docs/task_list.py."""
    stored = json.loads(list_tasks.LIST.read_text("utf-8"))
    read_task = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "task_list.py"))["read_task"]
    assert stored == json.loads(json.dumps({name: read_task(name) for name in package_task_names()}))
    for name in ("hopper", "humanoid", "pusher"):
        env = lw.make(name)
        sizes = [env.obs_space.size, env.action_space.size, env.task.frame_skip, env.timestep]
        assert [stored[name][column] for column in ("obs", "act", "skip", "dt")] == pytest.approx(sizes)


@pytest.mark.parametrize(("word", "task"), [("walker", "walker2d"), ("HOP", "hopper"), ("[hand]", "adroit_pen")])
def test_search_word_selects_tasks_by_name_description_or_model(
    word: str, task: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["tasks", word]) == 0
    listed = rows(capsys.readouterr().out)
    assert task in listed and "reach" not in listed


def test_search_word_without_matching_tasks_prints_a_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks", "submarine"]) == 2
    refused(capsys, "'submarine'", "lyceum-warp tasks")


def test_a_task_with_a_missing_extra_is_listed_with_the_command_that_installs_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if "robotics" in name else find(name, *a))
    assert cli.main(["tasks", "[hand]"]) == 0
    out, error = capsys.readouterr()
    assert error == "" and rows(out)["adroit_pen"] == [
        "45",
        "24",
        "5",
        "0.01",
        "s",
        "200",
        "gymnasium-robotics",
        "[hand]",
    ]
    about = out.partition("\nadroit_pen")[2].partition("\nadroit_relocate")[0]
    assert "    turn a pen in the hand" in about and "pip install 'lyceum-warp[hand]'" in " ".join(about.split())


@pytest.mark.long
def test_a_closed_pipe_ends_the_list_quietly() -> None:
    command = f"{sys.executable} -m lyceum_warp.cli tasks hopper | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stderr == ""
