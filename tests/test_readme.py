import re
from pathlib import Path

import pytest
from conftest import TaskFile

import lyceum_warp as lw

README = Path(__file__).parent.parent / "README.md"


def test_every_python_block_of_the_readme_runs(task_file: TaskFile, capsys: pytest.CaptureFixture) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 3
    # Warp compiles functions only from a source file
    env = lw.make(str(task_file("my_hopper.py", blocks[1])), nworld=2)
    assert env.task.name == "my_hopper"
    for block in (blocks[0], blocks[2]):
        exec(block, {"lw": lw})
    *_, first, second, third, planned = capsys.readouterr().out.splitlines()
    assert all(0 < float(line) < 200 for line in (first, second, third))
    assert planned.startswith("success: True")
