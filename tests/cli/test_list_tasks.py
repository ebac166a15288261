"""lyceum-warp tasks."""

import importlib.util
from typing import Any

import pytest

from lyceum_warp import cli
from lyceum_warp.binding.registry import task_names


def test_tasks_are_listed_with_their_sizes(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks"]) == 0
    out = capsys.readouterr().out
    line = next(line for line in out.splitlines() if "hopper" in line)
    assert line.split()[:7] == ["hopper", "11", "3", "4", "0.008", "s", "1000"]
    assert "hop forward on one leg" in line
    assert all(name in out for name in task_names())


def test_a_task_whose_extra_is_missing_is_listed_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec

    def find_others(name: str, *args: Any) -> Any:
        return None if name == "gymnasium_robotics" else find(name, *args)

    monkeypatch.setattr(importlib.util, "find_spec", find_others)
    assert cli.main(["tasks"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    assert all(name in out for name in task_names())
    text = " ".join(out.split())
    assert "adroit_pen - - - - - turn a pen in the hand" in text
    assert "needs: pip install 'lyceum-warp[hand]'" in text
