"""The README's Python runs unchanged."""

import re
from pathlib import Path

import pytest
from conftest import TaskFile

import lyceum_warp as lw

README = Path(__file__).parent.parent / "README.md"


def test_every_python_block_runs(task_file: TaskFile, capsys: pytest.CaptureFixture) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 4
    # Warp compiles the source of functions, so it must lie in a file, as a user's does
    env = lw.make(str(task_file("my_hopper.py", blocks[0])), nworld=2)
    assert env.task.name == "my_hopper"
    scope = {"lw": lw, "MyHopper": env.task.task}
    for block in blocks[1:]:
        exec(block, scope)
    out = capsys.readouterr().out
    assert "my_hopper on the mujoco engine" in out
    *_, first, second, third, planned = out.splitlines()
    assert all(0 < float(line) < 200 for line in (first, second, third))
    assert planned.startswith("success: True")


def test_the_task_is_shorter_than_in_the_paper() -> None:
    """The paper's appendix takes 39 lines for Hopper without its comments."""
    source = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert source is not None
    lines = [line for line in source[1].splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) < 39
