import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest
import torch
from conftest import TaskFile

import lyceum_warp as lw
from lyceum_warp.testing import check_task

ENGINES = ["mujoco", "warp"]

SOURCE = '''
"""An arm of two joints that follows a target, with everything that a task may use."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

XML = """
<mujoco model="arm">
  <option timestep="0.005"/>
  <size nuserdata="1"/>
  <worldbody>
    <geom type="plane" size="2 2 .1" pos="0 0 -.35"/>
    <body name="target" mocap="true" pos=".3 0 .2"><geom size=".02" contype="0" conaffinity="0"/></body>
    <body name="upper" pos="0 0 .2">
      <joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping=".1" range="-150 150" limited="true"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
        <site name="tip" pos=".3 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" ctrlrange="-2 3" ctrllimited="true"/>
    <motor name="elbow" joint="elbow" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
  <sensor>
    <accelerometer name="shock" site="tip"/>
    <framepos name="tip_position" objtype="site" objname="tip"/>
    <framelinvel name="tip_velocity" objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""


@wp.struct
class World:
    time: float
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    site_xpos: Row[wp.vec3]
    cvel: Row[wp.spatial_vector]
    sensordata: Row[float]
    mocap_pos: Row[wp.vec3]
    userdata: Row[float]
    total: Row[float] = lw.memory()
    drawn: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float
    gain: float = 1.0
    offset: wp.vec3 = wp.vec3(0.0, 0.0, 0.01)
    cost: float = 0.01
    distance: float = 0.05
    limit: int = 3
    tip: int = lw.site("tip")
    lower: int = lw.body("lower")
    target: int = lw.mocap("target")
    elbow: int = lw.qpos("elbow")
    velocity: int = lw.sensor("tip_velocity")
    shock: int = lw.sensor("shock")


@wp.func
def distance(s: World, p: Params) -> float:
    return wp.length(s.site_xpos[p.tip] - s.mocap_pos[p.target])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    gap = s.mocap_pos[p.target] - s.site_xpos[p.tip]
    for i in range(2):
        obs[i] = s.qpos[i]
        obs[2 + i] = s.qvel[i]
    for i in range(3):
        obs[4 + i] = gap[i]
        obs[7 + i] = s.sensordata[p.velocity + i]
        obs[10 + i] = s.cvel[p.lower][i]
        obs[13 + i] = s.xmat[p.lower][0, i]
    obs[16] = s.userdata[0]
    obs[17] = s.total[0]
    obs[18] = s.drawn[0]
    obs[19] = s.qpos[p.elbow] + s.xpos[p.lower][0]
    obs[20] = 1.0e-3 * s.sensordata[p.shock]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    effort = action[0] * action[0] + action[1] * action[1]
    return distance(s0, p) - distance(s1, p) - p.cost * effort + s1.drawn[0] - s0.drawn[0]


@wp.func
def evaluate(s: World, p: Params) -> float:
    return distance(s, p)


@wp.func
def success(s: World, p: Params) -> bool:
    return distance(s, p) < p.distance


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.abs(s.qpos[0]) > float(p.limit)


@wp.func
def servo(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for i in range(2):
        ctrl[i] = p.gain * action[i] - 0.1 * s.qvel[i]


@wp.func
def initialize(s: World, p: Params):
    s.qpos[1] = 0.5
    s.mocap_pos[p.target] = wp.vec3(0.4, 0.0, 0.3) + p.offset


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] += 0.1 * lw.normal(rng)
    s.mocap_pos[p.target] += wp.vec3(lw.uniform(rng, -0.1, 0.1), 0.0, lw.uniform(rng, -0.1, 0.1))
    s.userdata[0] = lw.uniform(rng, 1.0, 2.0)
    s.total[0] = -1.0


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.total[0] = s0.total[0] + action[0]
    s1.drawn[0] = lw.uniform(rng, 0.0, 1.0)


PARTS = {"joints": 4, "gap": 3, "speed": 3, "turn": 3, "axis": 3, "rest": 5}


@lw.register
class FollowTarget(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(XML))
    frame_skip = 4
    obs = PARTS
    horizon = 50
    control = servo


class ScaledActions(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(XML))
    frame_skip = 2
    obs = PARTS
    action_range = (-1.0, 1.0)
'''


def load(path: Path, name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def path(task_file: TaskFile) -> Path:
    return task_file("follow_target.py", SOURCE)


@pytest.fixture(scope="module")
def module(path: Path) -> ModuleType:
    return load(path, "user_follow_target")


def random_steps(env: lw.Env, n: int, seed: int = 0) -> None:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(n):
        env.step(2 * torch.rand(env.action.shape, generator=generator) - 1)


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_user_task_passes_check_task(module: ModuleType, engine: str) -> None:
    check_task("follow_target", engine=engine, steps=40, frame_skip=2, gain=np.array([0.5, 1.0, 1.5, 2.0]))


@pytest.mark.long
@pytest.mark.parametrize("engine", ENGINES)
def test_user_task_with_scaled_actions_and_rk4_passes_check_task(module: ModuleType, path: Path, engine: str) -> None:
    spec = mujoco.MjSpec.from_string(module.XML)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    check_task(f"{path}:ScaledActions", engine=engine, steps=100, model=spec, nworld=3)


@pytest.mark.parametrize("engine", ENGINES)
def test_fields_equal_mj_forward_of_the_state(module: ModuleType, engine: str) -> None:
    """The fields are current after a step, an automatic reset, set_state and rand_reset.

    The accelerometer's value is from the last substep, and matches the state only after a reset.
    """
    env = lw.make("follow_target", engine=engine, nworld=3, horizon=5, fields=["xipos"])
    centers = env.field("xipos")
    parts = env.state_space.parts

    def compare(when: str, accelerations: bool = False) -> None:
        state = env.get_state().numpy()
        for w in range(env.nworld):
            data = mujoco.MjData(env.model)
            data.qpos[:], data.qvel[:] = state[w, parts["qpos"]], state[w, parts["qvel"]]
            data.mocap_pos[:] = state[w, parts["mocap_pos"]].reshape(-1, 3)
            mujoco.mj_forward(env.model, data)
            for name in ("xpos", "xmat", "site_xpos", "cvel"):
                found, wanted = env.field(name)[w].numpy(), getattr(data, name)
                np.testing.assert_allclose(found.reshape(wanted.shape), wanted, atol=2e-5, err_msg=f"{name} {when}")
            np.testing.assert_allclose(centers[w].numpy(), data.xipos, atol=2e-5, err_msg=f"xipos {when}")
            first = 0 if accelerations else 3
            np.testing.assert_allclose(
                env.field("sensordata")[w, first:].numpy(), data.sensordata[first:], atol=2e-4, rtol=1e-4, err_msg=when
            )

    compare("after construction", accelerations=True)
    random_steps(env, 4)
    compare("after steps")
    state = env.get_state()
    random_steps(env, 1, 1)
    assert env.truncated.all()
    compare("after an automatic reset", accelerations=True)
    random_steps(env, 2, 2)
    env.set_state(state, torch.tensor([True, False, True]))
    compare("after set_state")
    env.rand_reset(7)
    compare("after rand_reset", accelerations=True)


@pytest.mark.parametrize("engine", ENGINES)
def test_acceleration_sensors_belong_to_the_last_substep(module: ModuleType, engine: str) -> None:
    env = lw.make("follow_target", engine=engine, nworld=2, frame_skip=1)
    random_steps(env, 3)
    parts, before = env.state_space.parts, env.get_state().numpy()
    random_steps(env, 1, 1)
    for w in range(2):
        data = mujoco.MjData(env.model)
        mujoco.mj_setState(
            env.model, data, before[w, : env.engine.integration_size], mujoco.mjtState.mjSTATE_INTEGRATION.value
        )
        data.ctrl[:] = env.get_state()[w, parts["ctrl"]].numpy()
        mujoco.mj_forward(env.model, data)
        np.testing.assert_allclose(env.field("sensordata", "shock")[w], data.sensor("shock").data, rtol=1e-3, atol=1e-3)


@pytest.mark.quick("warp")
@pytest.mark.parametrize("engine", ENGINES)
def test_additional_acceleration_field_is_part_of_the_state(module: ModuleType, engine: str) -> None:
    plain, env = (lw.make("follow_target", engine=engine, nworld=2, fields=fields) for fields in ((), ["qacc"]))
    assert env.state_space.size == plain.state_space.size + 2
    acceleration = env.field("qacc")
    random_steps(env, 6)
    state, kept = env.get_state(), acceleration.clone()
    assert kept.abs().min() > 0
    random_steps(env, 2, 1)
    assert not torch.equal(acceleration, kept)
    env.set_state(state)
    assert torch.equal(acceleration, kept)
    assert torch.equal(env.get_state(), state)
    torch.testing.assert_close(env.get_obs(state), env.obs, rtol=0, atol=0)


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_controls_are_computed_by_the_task_or_scaled_to_their_ranges(
    module: ModuleType, path: Path, engine: str
) -> None:
    env = lw.make("follow_target", engine=engine, nworld=2, gain=[1.0, 10.0])
    env.reset()
    env.step(torch.full((2, 2), 0.5))
    wanted = torch.tensor([[0.5, 0.5], [3.0, 1.0]])  # the second world's gain exceeds the control ranges
    torch.testing.assert_close(env.field("ctrl"), wanted)
    np.testing.assert_array_equal(env.action_space.high, [3, 1])

    env = lw.make(f"{path}:ScaledActions", engine=engine, nworld=3)
    np.testing.assert_array_equal(env.action_space.low, [-1, -1])
    env.step(torch.tensor([[-1.0, 0.0], [1.0, 0.5], [0.0, 2.0]]))
    torch.testing.assert_close(env.field("ctrl"), torch.tensor([[-2.0, 0.0], [3.0, 0.5], [0.5, 1.0]]))


@pytest.mark.parametrize("engine", ENGINES)
def test_task_memory_changes_in_every_step_and_is_cleared_by_a_reset(module: ModuleType, engine: str) -> None:
    env = lw.make("follow_target", engine=engine, nworld=2, horizon=3, seed=4)
    first = []
    for i in range(2):
        env.step(torch.full((2, 2), 0.5))
        torch.testing.assert_close(env.obs[:, 17], torch.full((2,), -1.0 + 0.5 * (i + 1)))
        first.append(env.obs[:, 18].clone())
    assert first[0][0] != first[0][1] and first[0][0] != first[1][0], "draws repeat over worlds or steps"
    env.step()
    assert env.truncated.all() and (env.obs[:, 17] == -1).all(), "the reset did not clear the memory"
    assert (env.final_obs[:, 17] == 0.5).all()
    env.rand_reset(4)
    env.step(torch.full((2, 2), 0.5))
    assert torch.equal(env.obs[:, 18], first[0])
    env.reset()
    assert (env.obs[:, 16:19] == 0).all()


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_set_params_takes_effect_in_the_next_step(module: ModuleType, engine: str) -> None:
    env, other = (lw.make("follow_target", engine=engine, nworld=2, seed=1, cost=cost) for cost in (0.0, 2.0))
    action = torch.full((2, 2), 0.5)
    for _ in range(3):
        env.step(action)
        other.step(action)
    torch.testing.assert_close(other.reward, env.reward - 1.0)
    env.set_params(cost=2.0)
    for _ in range(3):
        env.step(action)
        other.step(action)
        assert torch.equal(other.reward, env.reward)
    env.set_params(cost=[2.0, 4.0])
    for _ in range(3):
        env.step(action)
        other.step(action)
        torch.testing.assert_close(other.reward - env.reward, torch.tensor([0.0, 1.0]))
    state = env.get_state()
    env.step(action)
    torch.testing.assert_close(env.get_reward(state, action, env.get_state()), env.reward, rtol=0, atol=0)
    env.set_params(offset=(0, 0, 0.1), distance=100)
    env.reset()
    np.testing.assert_allclose(env.field("mocap_pos")[:, 0], [[0.4, 0, 0.4]] * 2, atol=1e-6)
    assert env.success.all()
    for wrong in ({"costs": 1.0}, {"offset": 1.0}, {"limit": 2.5}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            env.set_params(**wrong)
    assert env.task.params["limit"] == 3


def test_episode_terminates_in_a_state_beyond_the_limit(module: ModuleType) -> None:
    env = lw.make("follow_target", nworld=2, limit=1)
    state = env.get_state()
    state[0, env.state_space.parts["qpos"].start] = 1.2
    assert env.get_terminated(state).tolist() == [True, False]
    env.set_state(state)
    assert not env.done.any()
    env.step()
    assert env.done_reason.tolist() == [int(lw.Done.TERMINATED), 0]
