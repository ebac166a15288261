from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp import Done, Row
from lyceum_warp.binding import find_task
from lyceum_warp.engines.c.native_rollout import NativeRollout
from lyceum_warp.env import OpenLoop

ENGINES = ["mujoco", "warp"]
PACKAGE = [name for name in lw.task_names() if find_task(name).__module__.startswith("lyceum_warp.tasks.")]


ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="2 2 .1" pos="0 0 -.35"/>
    <body pos="0 0 .2">
      <joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <body pos=".3 0 0">
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
</mujoco>
"""


@wp.struct
class Arm:
    qpos: Row[float]
    qvel: Row[float]
    ctrl: Row[float]
    qfrc_applied: Row[float]
    site_xpos: Row[wp.vec3]
    kept: Row[float] = lw.memory(2)  # the memory contains a sum over the steps, and the random number of the last step


@wp.struct
class ArmParams:
    dt: float
    gain: float = 1.0
    cost: float = 0.01
    bound: float = 0.1
    tip: int = lw.site("tip")


@wp.func
def observe_arm(s: Arm, p: ArmParams, obs: Row[float]):
    for i in range(2):
        obs[i] = s.qpos[i]
        obs[2 + i] = s.qvel[i]
        obs[4 + i] = s.kept[i]
    for i in range(3):
        obs[6 + i] = s.site_xpos[p.tip][i]


@wp.func
def reward_of_arm(s0: Arm, action: Row[float], s1: Arm, p: ArmParams) -> float:
    r = s1.site_xpos[p.tip][2] - s0.site_xpos[p.tip][2] - p.cost * action[0] * action[1]
    r += 0.1 * s0.ctrl[0] - 0.2 * s1.ctrl[0] * s1.ctrl[1]
    return r + s1.kept[0] * s0.kept[0] + p.gain * s1.kept[1] + 0.1 * s1.qfrc_applied[1]


@wp.func
def swung_out(s: Arm, p: ArmParams) -> bool:
    return s.qpos[1] > p.bound


@wp.func
def remember_draws(s0: Arm, action: Row[float], s1: Arm, p: ArmParams, rng: Row[wp.uint32]):
    first = lw.uniform(rng, 0.0, 1.0)
    s1.kept[0] = 0.5 * s0.kept[0] + s1.site_xpos[p.tip][0] - action[0] * first
    s1.kept[1] = lw.normal(rng)


@wp.func
def servo(s: Arm, action: Row[float], p: ArmParams, ctrl: Row[float]):
    for i in range(2):
        ctrl[i] = p.gain * action[i] - 0.3 * s.qvel[i] - s.qpos[i]


class Forgetful(lw.Task):
    """The actions are controls, so the C engine computes a rollout in one native call."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(ARM))
    frame_skip = 3
    obs = {"joints": 4, "memory": 2, "tip": 3}
    World = Arm
    Params = ArmParams
    observe, reward, terminated, advance = observe_arm, reward_of_arm, swung_out, remember_draws


class Servo(Forgetful):
    """Controls depend on the state before the step."""

    control = servo


def under_rk4() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(ARM)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    return spec


def rollouts(task: str | type[lw.Task], steps: int, *, engine: str, nworld: int = 4, **options: Any) -> OpenLoop:
    env = lw.make(task, engine=engine, nworld=nworld, autoreset=False, **options)
    return OpenLoop(env, steps)


def random_actions(env: lw.Env, steps: int, seed: int) -> torch.Tensor:
    """Draw actions, many of which are out of bounds. Unbounded actions are drawn as if their bounds were -1 and 1."""
    generator = torch.Generator().manual_seed(seed)
    bounds = (torch.from_numpy(bound) for bound in (env.action_space.low, env.action_space.high))
    low, high = (bound.nan_to_num(neginf=-1.0, posinf=1.0) for bound in bounds)
    unit = torch.rand(steps, *env.action.shape, generator=generator)
    return low + (high - low) * (1.6 * unit - 0.3)


def some_state(env: lw.Env, seed: int, steps: int = 7) -> torch.Tensor:
    env.rand_reset(seed)
    for action in random_actions(env, steps, seed):
        env.step(action)
    state = env.get_state()[1 % env.nworld].clone()
    state[env.state_space.parts["done_reason"]] = 0
    return state


def run(loop: OpenLoop, state: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    loop.state.copy_(state)
    loop.actions.copy_(actions)
    loop.run()
    return {name: getattr(loop, name).clone() for name in ("reward", "terminated", "final_obs", "fault")}


def check_against_stepping(loop: OpenLoop, env: lw.Env, rounds: int = 3) -> None:
    """Check that rollouts give the same results as single steps. The later rollouts replay graphs."""
    for seed in range(rounds):
        state, actions = some_state(env, seed), random_actions(env, loop.horizon, 10 + seed)
        low, high = env.action_space.low, env.action_space.high
        assert ((actions.numpy() < low) | (actions.numpy() > high)).any() or not np.isfinite(high).any()
        found = run(loop, state, actions)
        assert not found["fault"].any() and torch.equal(loop.actions, actions)
        ended = found["terminated"].cumsum(0) > 0  # without automatic resets, terminated stays set
        env.set_state(state.expand(env.nworld, -1).contiguous())
        for t, action in enumerate(actions):
            env.step(action)
            assert not (env.done_reason & ~int(Done.TERMINATED | Done.TRUNCATED)).any()
            assert torch.equal(found["reward"][t], env.reward), f"reward of step {t}, round {seed}"
            assert torch.equal(ended[t], env.terminated), f"terminated of step {t}, round {seed}"
        assert torch.equal(found["final_obs"], env.final_obs), f"final_obs, round {seed}"
        assert len(env.final_obs.unique(dim=0)) == env.nworld, "all worlds are the same, so nothing was tested"


@pytest.mark.quick(
    "adroit_pen-mujoco", "cartpole-mujoco", "dm/quadruped_walk-mujoco", "go1_velocity-mujoco", "half_cheetah-mujoco",
    "humanoid_stand-mujoco", "panda_lift-mujoco", "soft_ball-mujoco", "reach-warp",
)  # fmt: skip
@pytest.mark.parametrize("task, engine", [(task, engine) for task in PACKAGE for engine in ENGINES])
def test_rollout_of_a_task_equals_steps(task: str, engine: str) -> None:
    steps = 3 if task == "humanoid" or task.startswith("adroit") else 5
    # on a CPU, a substep of the Warp engine takes hundreds of launches, so this test uses at most two
    options = {"frame_skip": min(2, find_task(task).frame_skip)} if engine == "warp" else {}
    env = lw.make(task, engine=engine, nworld=4, autoreset=False, **options)
    check_against_stepping(rollouts(task, steps, engine=engine, **options), env)


@pytest.fixture
def native_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    calls, original = [], NativeRollout.run

    def counting(self: NativeRollout, *args: Any) -> None:
        calls.append(1)
        original(self, *args)

    monkeypatch.setattr(NativeRollout, "run", counting)
    return calls


@pytest.mark.quick(
    "worlds-mujoco", "one_substep-mujoco", "rk4-mujoco", "control_worlds-mujoco", "memory-warp",
)  # fmt: skip
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("task", "native", "options"),
    [
        (Forgetful, True, {}),
        (Forgetful, True, {"gain": np.array([0.0, 0.5, 1.0, 2.0]), "cost": np.array([0.0, 1.0, 2.0, 3.0])}),
        (Forgetful, True, {"frame_skip": 1}),
        (Forgetful, False, {"model": under_rk4(), "frame_skip": 2}),
        (Servo, False, {}),
        (Servo, False, {"gain": np.array([0.0, 0.5, 1.0, 2.0]), "model": under_rk4(), "frame_skip": 2}),
    ],
    ids="memory worlds one_substep rk4 control control_worlds".split(),
)
def test_rollout_of_every_kind_of_task_equals_steps(
    task: type[lw.Task], native: bool, options: dict[str, Any], engine: str, native_calls: list[int]
) -> None:
    loop = rollouts(task, 6, engine=engine, **options)
    check_against_stepping(loop, lw.make(task, engine=engine, nworld=4, autoreset=False, **options))
    assert len(native_calls) == (3 if native and engine == "mujoco" else 0)


@pytest.mark.quick("Forgetful-mujoco", "Servo-warp")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", [Forgetful, Servo])
def test_random_numbers_of_worlds_depend_on_the_given_keys(task: type[lw.Task], engine: str) -> None:
    env = lw.make(task, engine=engine, nworld=4, autoreset=False)
    numbers = np.array([5, 2**32 - 1, 77, 1234567890], dtype=np.uint32)
    keys = wp.zeros(4, dtype=wp.uint32, device="cpu")
    loop = OpenLoop(lw.make(task, engine=engine, nworld=4, autoreset=False), 4, keys=keys)
    state, actions = some_state(env, 1), random_actions(env, 4, 2)
    for turn in range(2):
        keys.assign(np.roll(numbers, turn))
        found = run(loop, state, actions)
        states = state.repeat(4, 1)
        states[:, env.state_space.parts["key"]] = torch.from_numpy(keys.numpy().astype(np.float64))[:, None]
        env.set_state(states)
        for t, action in enumerate(actions):
            env.step(action)
            assert torch.equal(found["reward"][t], env.reward)
        assert torch.equal(found["final_obs"], env.final_obs)


def test_keys_of_wrong_shape_or_type_raise_an_error(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=2, autoreset=False)
    for wrong in (wp.zeros(3, dtype=wp.uint32, device="cpu"), wp.zeros(2, dtype=int, device="cpu")):
        with pytest.raises(ValueError, match=r"keys must be a wp.array of shape \(2,\) and type uint32 on cpu, not of"):
            OpenLoop(env, 3, keys=wrong)


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_terminated_is_computed_for_each_state_separately(engine: str) -> None:
    """The states are terminal only while the arm is swung out."""
    loop = rollouts(Forgetful, 40, engine=engine, nworld=2, bound=0.05)
    loop.env.reset()
    actions = torch.zeros(40, 2, 2)
    actions[:8, :, 1], actions[8:, :, 1] = 1.0, -1.0
    actions[:, 1] *= -1
    found = run(loop, loop.env.get_state()[0], actions)
    changes = found["terminated"][1:, 0] != found["terminated"][:-1, 0]
    assert changes.sum() == 2 and not found["terminated"][[0, -1], 0].any(), "out and back in again"
    assert found["terminated"][-1, 1], "the other world swings the other way first"


BAD = 1


@pytest.mark.quick("nan-Servo-warp", "nan-Forgetful-mujoco", "inf-Servo-mujoco")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", [Forgetful, Servo])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_non_finite_action_causes_a_fault_in_its_world(task: type[lw.Task], engine: str, number: float) -> None:
    loop = rollouts(task, 5, engine=engine)
    state, actions = some_state(loop.env, 0), random_actions(loop.env, 5, 0)
    zeroed, wrong = actions.clone(), actions.clone()
    zeroed[2, BAD] = 0.0
    wrong[2, BAD, 1] = number
    expected = run(loop, state, zeroed)
    assert not expected.pop("fault").any()
    for _ in range(3):
        found = run(loop, state, wrong)
        assert found.pop("fault").tolist() == [0, int(Done.ACTION), 0, 0]
        assert torch.equal(loop.actions, zeroed)
        for name, value in expected.items():
            assert torch.equal(found[name], value), name
    clean = run(loop, state, actions)
    assert not clean["fault"].any()
    others = torch.arange(4) != BAD
    assert torch.equal(clean["reward"][:, others], expected["reward"][:, others])
    assert not torch.equal(clean["reward"][:, BAD], expected["reward"][:, BAD])


RUNAWAY = """
<mujoco>
  <option timestep="0.01" {}/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .3">
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom size=".1" mass="1"/>
      <site name="tip"/>
    </body>
  </worldbody>
  <actuator><motor joint="up" gear="1e4" ctrllimited="false"/></actuator>
</mujoco>
"""


@wp.struct
class Ball:
    qpos: Row[float]
    site_xpos: Row[wp.vec3]


@wp.struct
class BallParams:
    dt: float


@wp.func
def observe_ball(s: Ball, p: BallParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.site_xpos[0][2]


@wp.func
def height_of_ball(s0: Ball, action: Row[float], s1: Ball, p: BallParams) -> float:
    return s1.site_xpos[0][2] + s0.qpos[0]


@wp.func
def push_ball(s: Ball, action: Row[float], p: BallParams, ctrl: Row[float]):
    ctrl[0] = action[0]


class Runaway(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(RUNAWAY.format("")))
    obs = {"height": 2}
    World = Ball
    Params = BallParams
    observe, reward = observe_ball, height_of_ball


class PushedRunaway(Runaway):
    control = push_ball


@pytest.mark.quick(
    "1000000000.0-5-control-warp", "1000000000.0-5-native-mujoco", "1000000000.0-1-rk4-mujoco",
    "10000000000000.0-1-native-mujoco",
)  # fmt: skip
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("how", ["native", "rk4", "control"])
@pytest.mark.parametrize("size, step", [(1e9, 1), (1e9, 5), (1e13, 1)])  # MuJoCo ignores controls beyond 1e10
def test_diverging_world_has_a_fault_and_does_not_change_other_worlds(
    size: float, how: str, step: int, engine: str
) -> None:
    """On the C engine, a diverging world keeps its last finite values, and only the fault marks them as invalid."""
    task = PushedRunaway if how == "control" else Runaway
    model = mujoco.MjSpec.from_string(RUNAWAY.format('integrator="RK4"' if how == "rk4" else ""))
    loop = rollouts(task, 6, engine=engine, model=model)
    loop.env.reset()
    state = loop.env.get_state()[0].clone()
    generator = torch.Generator().manual_seed(0)
    actions = 2e-3 * torch.randn(6, 4, 1, generator=generator)
    wild = actions.clone()
    wild[step, [1, 3]] = torch.tensor([[size], [-size]])
    clean = run(loop, state, actions)
    assert not clean["fault"].any()
    for _ in range(3):
        found = run(loop, state, wild)
        assert (found["fault"] != 0).tolist() == [False, True, False, True]
        assert size == 1e13 or (found["fault"][[1, 3]] & int(Done.NAN)).all()
        for name in ("reward", "terminated"):
            assert torch.equal(found[name][:, [0, 2]], clean[name][:, [0, 2]]), name
        assert torch.equal(found["final_obs"][[0, 2]], clean["final_obs"][[0, 2]])
        again = run(loop, state, actions)
        for name, value in clean.items():
            assert torch.equal(again[name], value), f"{name} of a rollout after one that diverged"


@pytest.mark.quick("PushedRunaway")
@pytest.mark.parametrize("task", [Runaway, PushedRunaway])
def test_fault_within_a_rollout_is_reported_at_its_end(task: type[lw.Task]) -> None:
    """A ball is pushed into the floor until the constraint buffer overflows. Then the ball flies up again."""
    loop = rollouts(task, 20, engine="warp", nworld=3, nconmax=8, njmax=2)
    loop.env.reset()
    state = loop.env.get_state()[0].clone()
    actions = torch.full((20, 3, 1), 9.81e-4)
    actions[:12, BAD], actions[12:, BAD] = -4e-3, 8e-2
    for _ in range(3):
        found = run(loop, state, actions)
        assert found["final_obs"][BAD, 1] > 0.2, "it lies on the floor at the end, so nothing was tested"
        assert found["fault"].tolist() == [0, int(Done.CONSTRAINT_OVERFLOW), 0]
    assert not run(loop, state, torch.full_like(actions, 9.81e-4))["fault"].any()


def test_unsuitable_environment_horizon_or_number_of_states_raises_an_error(shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match=r"worlds that do not reset: make\(..., autoreset=False\)"):
        OpenLoop(shared_env("point_mass"), 5)
    env = shared_env("point_mass", autoreset=False)
    for horizon in (0, -1, 2.5, "a"):
        with pytest.raises(ValueError, match="horizon must be a whole number from 1"):
            OpenLoop(env, horizon)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="nworld=1 must be a multiple of states=4"):
        OpenLoop(env, 3, states=4)
