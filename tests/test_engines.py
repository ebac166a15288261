"""What a task can do on one engine it can do on the other: fields, controls and resets beyond the package's tasks."""

import gc
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import lyceum_warp as lw

TASK = """
import mujoco
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    ctrl: Row[float]
    sensordata: Row[float]


@wp.struct
class Params:
    dt: float
    memory_of_control: float = 0.9


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.sensordata[0]
    obs[2] = s.ctrl[0]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = p.memory_of_control * ctrl[0] + (1.0 - p.memory_of_control) * action[0]


@wp.func
def initialize(s: World, p: Params):
    s.qpos[0] = 0.5


def pendulum():
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.01
    body = spec.worldbody.add_body(name="rod")
    body.add_joint(name="hinge", axis=(0, 1, 0))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0, 0, 0, 0, 0, -1), size=(0.05, 0, 0))
    motor = spec.add_actuator(name="motor", target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.ctrllimited, motor.ctrlrange = True, (-1, 1)
    spec.add_sensor(name="angle", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT,
                    objname="hinge")
    return spec


class Filtered(lw.Task):
    model = staticmethod(pendulum)
    lagged = ("sensordata",)
    obs = {"angle": 1, "sensed_angle": 1, "control": 1}
    horizon = 6
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("tasks") / "filtered.py"
    file.write_text(TASK)
    return file


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_lagged_fields_are_those_of_the_new_state_after_a_reset(file: Path, engine: str) -> None:
    env = lw.make(file, engine=engine, nworld=2)
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))
    for _ in range(6):
        env.step(torch.ones(2, 1))
        if not env.done.any():  # one substep behind the state
            assert (env.obs[:, 0] != env.obs[:, 1]).all()
    assert env.truncated.all()
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_controls_belong_to_the_state(file: Path, engine: str) -> None:
    """A control that filters goes on from what was restored, and starts from zero after a reset."""
    env = lw.make(file, engine=engine, nworld=2, horizon=0)
    action = torch.ones(2, 1)

    def run() -> list[float]:
        controls = []
        for _ in range(4):
            env.step(action)
            controls.append(env.obs[0, 2].item())
        return controls

    env.reset()
    first, state = run(), env.get_state()
    np.testing.assert_allclose(first, 1 - 0.9 ** np.arange(1, 5), rtol=1e-5)
    after = run()
    env.set_state(state)
    assert run() == after
    env.reset()
    assert run() == first


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_view_of_a_field_outlives_its_environment(engine: str) -> None:
    field = lw.make("point_mass", engine=engine, nworld=64).field("qpos")
    before = field.clone()
    gc.collect()
    junk = [torch.full((64, 4), 7.0) for _ in range(200)]
    assert torch.equal(field, before), junk[0][0]


def test_asking_for_a_field_changes_nothing(file: Path) -> None:
    plain, curious = lw.make(file, nworld=2, seed=3), lw.make(file, nworld=2, seed=3)
    curious.field("qacc_warmstart")
    curious.field("xpos")
    for _ in range(8):
        plain.step(torch.ones(2, 1))
        curious.step(torch.ones(2, 1))
        assert torch.equal(plain.get_state(), curious.get_state())


def test_a_reset_leaves_the_faults_of_other_worlds_alone() -> None:
    env = lw.make("hopper", nworld=3)
    env.step()
    env.engine.batch.warning[2, mujoco.mjtWarning.mjWARN_INERTIA.value, 1] = 1  # type: ignore[attr-defined]
    env.rand_reset(mask=torch.tensor([True, False, False]))
    env.step()
    assert env.done_reason.tolist() == [0, 0, int(lw.Done.ENGINE_WARNING)]
