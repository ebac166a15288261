"""What is wrong in a task's file is said in one line; once it is mended, the file is read again."""

from pathlib import Path

import pytest
import torch

import lyceum_warp as lw

TINY = """
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row

@wp.struct
class World:
    qpos: Row[float]

@wp.struct
class Params:
    dt: float

@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]

class Tiny(lw.Task):
    model = "hopper.xml"
    obs = {"x": 1}
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("qpos: Row[float]", "qpos: Row[float]\n    qpoz: Row[float]", "no field 'qpoz': did you mean qpos"),
        ("qpos: Row[float]", "qpos: Row[wp.vec3]", r"World.qpos of the task 'tiny' has to be declared as Row\[float"),
        ("qpos: Row[float]", "qpos: Row[float]\n    xpos: Row[float]", r"World.xpos .* declared as Row\[wp.vec3"),
        ("qpos: Row[float]", "qpos: Row[float]\n    time: Row[float]", "World.time .* declared as float"),
        ("def observe", "def look", r"'tiny' has no observe\(s, p, obs\)"),
        ("    obs = {", "    parts = {", "'tiny' has no obs: add"),
        ("    model = ", "    file = ", "'tiny' has no model: add"),
        ('"hopper.xml"', '"hoper.xml"', "no model file 'hoper.xml' in .*; it has hopper.xml"),
        ('"hopper.xml"', '"/nowhere/hopper.xml"', "no model file '/nowhere/hopper.xml'"),
        ("@wp.func\n", "", "observe of the task 'tiny' has to be a @wp.func"),
        ("    obs = {", "    memory = 1\n    obs = {", "memory in World"),
        ("    obs = {", "    lagged = ('qvel',)\n    obs = {", "wants 'qvel' lagged but does not list it in World"),
        ("    obs = {", "    frame_skip = 0\n    obs = {", "frame_skip must be a whole number from 1 to .*, not 0"),
        ("    dt: float", "    dt: float\n    name: str", r"task file .*tiny\.py, line \d+: AttributeError: .*'str'"),
        ("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0", r"task file .*tiny\.py, line \d+: SyntaxError: "),
        ("obs: Row[float]):", "obs: 'Row[float]'):", "observe .* has annotations that are text, not types"),
        ("class Tiny", "@wp.func\ndef evaluate(s: World, p: Params) -> float:\n    wp.abs(s.qpos[0])\n\nclass Tiny",
         r"evaluate of the task 'tiny' has no return: it is written as evaluate\(s: World"),
        ("    dt: float", "    dt: float\n    foot: float = lw.geom('foot_geom')", "foot .* has to be declared as int"),
    ],
)  # fmt: skip
def test_a_broken_task_says_what_to_mend(old: str, new: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "tiny.py"
    assert old in TINY
    file.write_text(TINY.replace(old, new, 1))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        lw.make(str(file))


def test_a_model_file_beside_the_task_is_looked_for_there(tmp_path: Path) -> None:
    (tmp_path / "tiny.py").write_text(TINY.replace("hopper.xml", "robott.xml"))
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    with pytest.raises(
        FileNotFoundError, match=r"no model file .*robott.xml \(did you mean robot.xml\?\), and of Gymn"
    ):
        lw.make(str(tmp_path / "tiny.py"))


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "tiny.py"
    file.write_text(TINY)
    old = lw.make(file)
    file.write_text(TINY.replace("obs[0] = s.qpos[0]", "obs[0] = 2.0 * s.qpos[0"))
    with pytest.raises(ValueError, match="SyntaxError"):
        lw.make(file)
    file.write_text(TINY.replace("obs[0] = s.qpos[0]", "obs[0] = 2.0 * s.qpos[0] + 1.0"))
    new = lw.make(file)
    for env in (old, old.replicate(), new):
        env.reset()
        env.step()
        x = env.field("qpos")[:, :1]
        assert torch.equal(env.obs, 2.0 * x + 1.0 if env is new else x)


@pytest.mark.parametrize(
    "change, message",
    [
        ("obs[0] = s.qpos[0]\n    obs[2] = 1.0", "writes 3 numbers, but obs declares 1"),
        ("pass", r"leaves the places \[0\] of obs unwritten"),
        ("obs[0] = wp.sqrt(s.qpos[0] - 100.0)", r"makes the places \[0\] of obs not a number \(NaN\)"),
    ],
)
def test_an_observation_of_another_size_is_refused(tmp_path: Path, change: str, message: str) -> None:
    file = tmp_path / "tiny.py"
    file.write_text(TINY.replace("obs[0] = s.qpos[0]", change))
    with pytest.raises(ValueError, match=message):
        lw.make(str(file))
