"""A forward pass of restarting worlds alone gives the same numbers as a forward pass of all worlds."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from conftest import TaskFile

import lyceum_warp as lw
from lyceum_warp.engines.warp.warp_engine import WarpEngine


@pytest.fixture(params=["mujoco", "warp", "warp without partial passes"])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """An engine; on the Warp engine with and without forward passes of a few worlds."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", request.param == "warp")
    return request.param.partition(" ")[0]


def test_partial_passes_give_the_same_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """In groups of one world or all together, a run is the same to the bit."""
    runs = []
    for partial in (True, False):
        monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
        env = lw.make("humanoid", engine="warp", nworld=3, horizon=5, seed=1)
        state = env.get_state()
        state[1, env.state_space.parts["step"]] = 3
        env.set_state(state)
        run = []
        for _ in range(8):
            env.step(torch.full_like(env.action, 0.3))
            run.append((env.done.clone(), env.obs.clone(), env.get_state()))
        runs.append(run)
    assert sum(int(done.sum()) for done, *_ in runs[0]) >= 4
    for one, other in zip(*runs, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("partial", [True, False])
def test_an_overflow_in_the_first_state_of_an_episode_is_reported(
    partial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first step reports it; here a world starts in more contacts than have room."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
    spec = lw.gymnasium_model("humanoid.xml").spec()
    spec.body("torso").pos[2] = 0.1
    env = lw.make("humanoid", engine="warp", nworld=2, model=spec, nconmax=1, njmax=128, reset_noise_scale=0.0,
                  autoreset=False)  # fmt: skip
    env.reset(torch.tensor([True, False]))
    assert not env.done.any()
    env.step()
    assert env.done_reason[0] & int(lw.Done.CONTACT_OVERFLOW)


TASK = '''
import mujoco
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row

MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="weight" pos="0 0 3"><joint name="slide" type="slide" axis="0 0 1"/><geom size=".1"/></body>
    <body name="rod" pos="0 0 2">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size=".05"/>
      <site name="tip" pos="0 0 -1"/>
    </body>
  </worldbody>
  <equality><joint name="held" joint1="slide" polycoef="0 0 0 0 0"/></equality>
  <actuator><motor name="motor" joint="hinge" ctrllimited="true" ctrlrange="-1 1"/></actuator>
  <sensor>
    <jointvel name="slow" joint="hinge" nsample="4" interval="0.02"/>
    <accelerometer name="tip" site="tip"/>
    <accelerometer name="slow_tip" site="tip" nsample="4" interval="0.02"/>
  </sensor>
</mujoco>
"""


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    qacc: Row[float]
    sensordata: Row[float]


@wp.struct
class Params:
    dt: float


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(7):
        obs[i] = s.sensordata[i]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[1] = lw.uniform(rng, -1.0, 1.0)
    s.qvel[1] = lw.uniform(rng, -1.0, 1.0)


class Sampled(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(MODEL))
    obs = {"sensors": 7}
    horizon = 0
'''


@pytest.fixture(scope="module")
def file(task_file: TaskFile) -> Path:
    return task_file("sampled.py", TASK)


def full_forward(env: lw.Env, world: int) -> mujoco.MjData:
    """MuJoCo's own forward pass at a world's state, with the sensors' histories of a reset."""
    data, state = mujoco.MjData(env.model), env.state_space.split(env.get_state())
    data.qpos[:], data.qvel[:] = state["qpos"][world], state["qvel"][world]
    data.eq_active[:] = state["eq_active"][world]
    mujoco.mj_forward(env.model, data)
    return data


def test_sensor_histories_belong_to_their_worlds_after_a_reset(file: Path, engine: str) -> None:
    """A sensor with an interval reads its history, which must be that of its own world."""
    env = lw.make(file, engine=engine, nworld=3)
    all_worlds, middle = torch.ones(3, dtype=torch.bool), torch.tensor([False, True, False])
    for mask in (all_worlds, middle):
        before = env.obs.clone(), env.get_state()
        env.rand_reset(mask=mask)
        assert len(env.obs[:, 0].unique()) == 3
        for world in mask.nonzero().ravel().tolist():
            wanted = full_forward(env, world).sensordata
            np.testing.assert_allclose(env.obs[world], wanted, rtol=1e-4, atol=1e-4)
        assert torch.equal(env.obs[~mask], before[0][~mask])
        assert torch.equal(env.get_state()[~mask], before[1][~mask])
        env.step()
        env.step(torch.ones_like(env.action))


def test_sensor_histories_restart_within_a_step(file: Path, engine: str) -> None:
    """A world that restarts alone continues as one whose neighbours restart with it."""
    histories = []
    for alone in (True, False):
        env = lw.make(file, engine=engine, nworld=3, horizon=3, seed=4)
        state, step = env.get_state(), env.state_space.parts["step"]
        state[:, step] = torch.tensor([[0.0], [2.0], [0.0]]) if alone else 2.0
        env.set_state(state)
        for _ in range(2):
            env.step(torch.ones_like(env.action))
        histories.append(env.state_space.split(env.get_state())["history"][1])
    assert torch.equal(*histories) and histories[0].any()


@pytest.mark.parametrize("partial", [True, False])
def test_equality_constraints_are_those_of_their_worlds(
    file: Path, partial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A world without its equality constraint falls; the others hold their weight."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
    env = lw.make(file, engine="warp", nworld=3)
    state = env.get_state()
    state[1, env.state_space.parts["eq_active"]] = 0
    env.set_state(state)
    env.engine.refresh(wp.full(3, True, dtype=bool, device="cpu"))
    wanted = [full_forward(env, world).qacc[0] for world in range(3)]
    np.testing.assert_allclose(env.field("qacc")[:, 0], wanted, rtol=1e-3)
    assert wanted[1] < -9 < min(wanted[0], wanted[2])
