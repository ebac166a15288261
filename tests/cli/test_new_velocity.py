import re
from pathlib import Path

import numpy as np
import pytest
import torch
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.binding import find_task
from lyceum_warp.testing import check_task

SLED = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .3">
      <freejoint/>
      <geom type="box" size=".2 .1 .05"/>
      <body name="left" pos="0 .15 0">
        <joint name="left_hip" axis="0 1 0" range="-60 60" actuatorfrcrange="-20 20"/>
        <geom name="left_shin" type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>
        <body name="left_sole" pos="0 0 -.25"><geom name="left_box" type="box" size=".06 .03 .02" pos=".02 0 0"/></body>
      </body>
      <body name="right" pos="0 -.15 0">
        <joint name="right_hip" axis="0 1 0" range="-60 60" actuatorfrcrange="-20 20"/>
        <geom name="right_shin" type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>
        <body name="right_sole" pos="0 0 -.25">
          <geom name="right_box" type="box" size=".06 .03 .02" pos=".02 0 0"/><site name="toe" pos=".02 0 -.02"/>
        </body>
      </body>
      <body name="tail" pos="-.2 0 0">
        <joint name="tail" axis="0 0 1" range="-60 60" actuatorfrcrange="-2 2"/>
        <geom type="capsule" fromto="0 0 0 -.2 0 0" size=".01"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="left"><joint joint="left_hip" coef="1"/></fixed></tendon>
  <actuator>
    <position name="right_hip" joint="right_hip" kp="40" kv="2"/>
    <position name="left_hip" joint="left_hip" kp="40" kv="2"/>
    <motor name="tail" joint="tail" gear="2" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
"""A robot with two legs and a tail.

Its feet are boxes in bodies without joints. Actuators and joints have different orders.
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sled.xml").write_text(SLED)
    return tmp_path


def new(*words: str) -> int:
    return cli.main(["new", *words, "--template", "velocity"])


@pytest.mark.long
def test_new_velocity_file_is_short_and_its_task_passes_check_task(folder: Path) -> None:
    assert new("ant_walk", "--model", "gymnasium:ant.xml") == 0
    text = Path("ant_walk.py").read_text()
    assert len(text.splitlines()) < 60 and max(map(len, text.splitlines())) <= 120
    check_task("ant_walk.py", engine="mujoco", nworld=3, steps=30)
    env = lw.make("ant_walk.py", nworld=2)
    legs = [env.model.joint(name).id for leg in range(1, 5) for name in (f"hip_{leg}", f"ankle_{leg}")]
    assert env.task.params["joints"].tolist() == legs and env.obs.shape == (2, 12 + 3 * 8)
    assert len(env.task.params["feet"]) == 4


def test_motors_are_replaced_by_servos_that_hold_the_pose(folder: Path) -> None:
    assert new("ant_walk", "--model", "gymnasium:ant.xml") == 0
    env = lw.make("ant_walk.py", nworld=2, push_seconds=(1e6, 1e6))
    for _ in range(100):
        env.step(torch.zeros(2, 8))
    pose = env.field("qpos")[:, 7:].numpy()
    default = np.array(env.task.params["default_pose"])[np.argsort(env.task.params["joints"])]
    assert np.abs(pose - default).max() < 0.25 and not env.terminated.any()
    assert env.obs_groups["critic"][:, -16:-12].all(), "all feet touch the ground"


def test_feet_and_joints_are_found_on_the_legs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert new("sled_walk", "--model", "sled.xml") == 0
    out = capsys.readouterr().out
    assert out.startswith("sled_walk.py: feet foot_1, toe; joints left_hip, right_hip\n")
    assert re.search(r"\d+ substeps of \d+ ms with \w+ friction cones.* lyceum-warp tune sled_walk\.py", out)
    env = lw.make("sled_walk.py", nworld=1, **{"push_seconds": (1e6, 1e6), "sliding_friction": (1.0, 1.0)})
    left, right = (env.model.site(name) for name in ("foot_1", "toe"))
    np.testing.assert_allclose(left.pos, [0.02, 0.0, -0.02], atol=1e-6)
    np.testing.assert_allclose(right.pos, [0.02, 0.0, -0.02], atol=1e-6)
    env.step(torch.tensor([[1.0, -1.0]]))
    right_hip, left_hip, tail = env.field("ctrl")[0].tolist()
    assert left_hip > 0.25 > -0.25 > right_hip and tail == 0.0
    assert issubclass(find_task("sled_walk.py"), lw.Task) and find_task("sled_walk.py").rewards["single_stance"] > 0


def test_new_task_uses_the_given_feet_and_joints(folder: Path) -> None:
    assert new("sled_stand", "--model", "sled.xml", "--feet", "left_shin", "toe", "--joints", "left_hip") == 0
    params = lw.make("sled_stand.py").task
    assert [params.model.site(i).name for i in params.params["feet"]] == ["left_shin_foot", "toe"]
    assert [params.model.joint(i).name for i in params.params["joints"]] == ["left_hip"]


SERVO = '<position name="left_hip" joint="left_hip" kp="40" kv="2"/>'


@pytest.mark.parametrize(("change", "options", "words"), [
    ((), ["--feet", "tow"], ["sled.xml", "'tow'", "--feet"]),
    ((), ["--joints", "hip"], ["sled.xml", "'hip'", "--joints"]),
    (("<freejoint/>", ""), [], ["sled.xml", "not a free joint"]),
    (('<geom name="floor" type="plane" size="5 5 .1"/>', ""), [], ["sled.xml", "no floor"]),
    ((SERVO, ""), ["--joints", "left_hip"], ["sled.xml", "'left_hip' has 0 actuators"]),
    ((SERVO, '<motor tendon="left" ctrlrange="-1 1"/>'), [], ["sled.xml", "'left_hip' has 0 actuators"]),
])  # fmt: skip
def test_robot_without_legs_prints_an_error(
    folder: Path, change: tuple[str, str], options: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("sled.xml").write_text(SLED.replace(*change) if change else SLED)
    assert new("sled_walk", "--model", "sled.xml", *options) == 2
    refused(capsys, *words)
    assert not Path("sled_walk.py").exists()


def test_option_feet_without_the_template_prints_an_error(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["new", "sled_walk", "--model", "sled.xml", "--feet", "toe"]) == 2
    refused(capsys, "--feet", "--template velocity")


@pytest.mark.long
@pytest.mark.parametrize("task", ["spot_velocity", "g1_velocity"])
def test_new_velocity_accepts_robots_of_menagerie(task: str, folder: Path) -> None:
    model = {"g1_velocity": "unitree_g1/scene_mjx.xml", "spot_velocity": "boston_dynamics_spot/scene.xml"}[task]
    assert new("walk", "--model", f"menagerie:{model}") == 0
    new_task, package_task = lw.make("walk.py").task, lw.make(task).task
    names = [[task.model.joint(i).name for i in task.params["joints"]] for task in (new_task, package_task)]
    assert names[0] == names[1] and len(new_task.params["feet"]) == len(package_task.params["feet"])
