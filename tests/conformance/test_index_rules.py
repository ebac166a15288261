import re

import pytest
import tiny_task
from conftest import TaskFile

from lyceum_warp.testing import check_task
from lyceum_warp.testing.index_rules import check_bounds

ENGINES = ["mujoco", "warp"]

MISTAKES = [
    r"observe reads s\.qpos\[60\] out of range \(wrong\.py, line \d+\): the index is 60, and there are 6 elements, 0",
    r"observe writes obs\[2\] out of range \(wrong\.py, line \d+\): the index is 2, and there are 2 elements",
    r"reward reads s1\.count\[1\] out of range \(wrong\.py, line \d+\): the index is 1, and there are 1 elements",
    r"height reads s\.xpos\[p\.tip\] out of range \(wrong\.py, line \d+\): the index is 7, and there are 5 elements",
    r"terminated reads s\.qpos\[p\.joint - 1\] out of range \(wrong\.py, line \d+\): the index is -1, ",
    r"control reads action\[3\] out of range ",
    r"initialize reads s\.count\[1\] out of range ",
    r"advance reads s0\.count\[int\(s0\.count\[0\]\)\] out of range .*: the index is 2, ",
]

FIELDS = "    qpos: Row[float]"
WRONG = tiny_task.changed(
    (
        FIELDS,
        f"{FIELDS}\n    xpos: Row[wp.vec3]\n    count: Row[float] = lw.memory()\n    more: Row[float] = lw.memory(9)",
    ),
    ("    dt: float", "    dt: float\n    tip: int = 7\n    joint: int = 0"),
    (
        "    obs[0] = s.qpos[0]",
        "    obs[0] = wp.clamp(s.qpos[60], -1.0, 1.0)\n    obs[1] = 0.0\n"
        "    if s.count[0] > 1.0:\n        obs[2] = 1.0",
    ),
    ('obs = {"x": 1}', 'obs = {"x": 2}\n    horizon = 5'),
    (
        "class Tiny",
        """@wp.func
def height(s: World, p: Params) -> float:
    return s.xpos[p.tip][2]

@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = action[3]

@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.count[0] = s0.count[0] + 1.0
    if s0.count[0] == 2.0:
        s1.count[0] += s0.count[int(s0.count[0])]

@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.clamp(s1.count[1], 0.0, 1.0)

@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.clamp(height(s, p), 0.0, 1.0)

@wp.func
def terminated(s: World, p: Params) -> bool:
    return s.qpos[p.joint - 1] > 100.0

@wp.func
def initialize(s: World, p: Params):
    if s.count[1] > 1.0e30:
        s.count[0] = 0.0

class Tiny""",
    ),
)  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
def test_index_rule_reports_indices_out_of_range(task_file: TaskFile, engine: str) -> None:
    with pytest.raises(AssertionError, match="tiny on the .* engine breaks the rule 'bounds': ") as caught:
        check_task(task_file("wrong.py", WRONG), engine=engine, steps=10, checks=[check_bounds])
    message = str(caught.value)
    assert message.count("\n") == 1
    for pattern in MISTAKES:
        assert re.search(pattern, message), f"{pattern} is not in {message}"
    assert message.count("out of range") == len(MISTAKES)


@pytest.mark.parametrize("engine", ENGINES)
def test_index_rule_reports_an_element_of_an_empty_field(task_file: TaskFile, engine: str) -> None:
    text = tiny_task.changed(
        (FIELDS, f"{FIELDS}\n    ten_length: Row[float]"), ("obs[0] = s.qpos[0]", "obs[0] = s.ten_length[1]")
    )
    file = task_file("without.py", text)
    with pytest.raises(AssertionError, match=r"observe reads s\.ten_length\[1\] out of range .* there are no elements"):
        check_task(file, engine=engine, steps=2, checks=[check_bounds])
