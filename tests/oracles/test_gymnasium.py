"""Compare tasks with their Gymnasium environments on the C engine.

Both run the same C code in float64. From equal states, their results differ only by rounding to float32. The tests find
tasks by their attribute ``gymnasium``, so new tasks are included.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch
from checks import check_same_distribution
from gymnasium.envs.mujoco import mujoco_env
from gymnasium.envs.registration import load_env_creator

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.binding.functions import TaskSource

gymnasium.register_envs(gymnasium_robotics)

IDS = {name: id for name in lw.task_names() if (id := find_task(name).gymnasium) is not None}
OWN = {spec.id: spec for spec in gymnasium.registry.values() if "gymnasium.envs.mujoco" in str(spec.entry_point)}
TASKS = [name for name, id in IDS.items() if id in OWN]


SOURCES = {task: TaskSource(find_task(task)) for task in TASKS}


def has(task: str, function: str) -> bool:
    return SOURCES[task].functions[function] is not None


# for these tasks, Gymnasium's class gets the mixin SensorStage
WITH_FORCES = [task for task in TASKS if "cfrc_ext" in SOURCES[task].types]


class SensorStage:
    """Make Gymnasium environments use lyceum_warp's solver (Newton), and compute contact forces as lyceum_warp does.

    Gymnasium computes ``cfrc_ext`` again after the last substep. This class computes it in the sensor stage of the last
    substep.
    """

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(self.fullpath)  # type: ignore[attr-defined]
        spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
        body = spec.bodies[1].name
        spec.add_sensor(type=mujoco.mjtSensor.mjSENS_FRAMELINACC, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=body)
        model = spec.compile()
        return model, mujoco.MjData(model)

    def _step_mujoco_simulation(self, ctrl: np.ndarray, n_frames: int) -> None:
        self.data.ctrl[:] = ctrl  # type: ignore[attr-defined]
        mujoco.mj_step(self.model, self.data, nstep=n_frames)  # type: ignore[attr-defined]


def unchanged(task: str) -> type[mujoco_env.MujocoEnv]:
    return load_env_creator(OWN[IDS[task]].entry_point)


@functools.cache
def oracle(task: str) -> type[mujoco_env.MujocoEnv]:
    """Return Gymnasium's class, with SensorStage as a base if the task observes contact forces."""
    base = unchanged(task)
    return type(base.__name__, (SensorStage, base), {}) if task in WITH_FORCES else base


def make_ours(task: str, **options: Any) -> lw.Env:
    return lw.make(task, **{"engine": "mujoco", "autoreset": False, "horizon": 0, "nthread": 1} | options)


def make_theirs(task: str, **options: Any) -> Any:
    return oracle(task)(**options)


def relative_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.max(np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs)), initial=0.0))


@dataclasses.dataclass
class Step:
    obs: np.ndarray
    gym_obs: np.ndarray
    reward: float
    gym_reward: float
    terminated: bool
    gym_terminated: bool
    eval: float
    gym_eval: float
    metrics: dict[str, float]
    info: dict[str, Any]
    reward_scale: float

    @property
    def reward_error(self) -> float:
        return abs(self.reward - self.gym_reward) / self.reward_scale


class Pair:
    def __init__(self, ours: lw.Env, theirs: Any) -> None:
        self.ours, self.theirs = ours, theirs
        self.rng = np.random.default_rng(0)
        theirs.reset(seed=0)
        low, high = theirs.model.actuator_ctrlrange.T
        self.middle, self.reach = (low + high) / 2, (high - low) / 2
        self.held = self.action()

    def put(self, change: Callable[[mujoco.MjData], None] = lambda data: None) -> None:
        """Reset Gymnasium's environment, change its data, and copy its state to our environment."""
        data = self.theirs.data
        mujoco.mj_resetData(self.theirs.model, data)
        self.theirs.reset_model()
        change(data)
        data.time = 0.5
        data.qpos[:], data.qvel[:] = np.float32(data.qpos), np.float32(data.qvel)
        mujoco.mj_forward(self.theirs.model, data)
        data.qacc_warmstart[:] = np.float32(data.qacc)

        state = self.ours.get_state()
        parts = self.ours.state_space.split(state[0])
        for name in parts.keys() - {"step", "key", "episode", "done_reason", "metrics"}:
            # fields from the previous forward pass are part of the state
            parts[name].copy_(torch.from_numpy(np.ravel(getattr(data, name))))
        parts["done_reason"].zero_()
        self.ours.set_state(state)

    def action(self) -> np.ndarray:
        """Return a random action. One action in four exceeds the control range."""
        return np.float32(self.middle + 1.33 * self.reach * self.rng.uniform(-1.0, 1.0, self.middle.shape))

    def step(self) -> Step:
        if self.rng.random() < 0.7:  # repeat the last action with probability 0.3, so that the robot moves further
            self.held = self.action()
        self.ours.step(torch.from_numpy(self.held[None]))
        obs, reward, terminated, truncated, info = self.theirs.step(self.held.astype(np.float64))
        assert not truncated
        assert self.ours.autoreset or torch.equal(self.ours.obs, self.ours.final_obs)
        return Step(
            obs=self.ours.final_obs[0].numpy().astype(np.float64),
            gym_obs=obs,
            reward=self.ours.reward.item(),
            gym_reward=float(reward),
            terminated=bool(self.ours.terminated.item()),
            gym_terminated=bool(terminated),
            eval=self.ours.eval.item(),
            gym_eval=evaluation(self.ours.task.name, self.theirs, info),
            metrics={name: float(value) for name, value in self.ours.metrics.items()},
            info=info,
            reward_scale=max(1.0, abs(reward), 1e-7 * abs(self.theirs.data.qpos[0]) / self.theirs.dt),
        )

    def run(self, nstep: int, restart: int = 200) -> list[Step]:
        steps: list[Step] = []
        since = restart
        for _ in range(nstep):
            if since == restart or steps[-1].terminated or steps[-1].gym_terminated:
                self.put()
                since = 0
            steps.append(self.step())
            since += 1
        return steps


def evaluation(task: str, theirs: Any, info: Mapping[str, Any]) -> float:
    """Return the value that ``Env.eval`` must have after a step of Gymnasium's environment."""
    if task == "inverted_pendulum":
        return abs(theirs.data.qpos[1])
    if task == "inverted_double_pendulum":
        return theirs.data.site("tip").xpos[2]
    if task == "humanoid_standup":
        return theirs.data.qpos[2]
    return -info["reward_dist"] / theirs._reward_dist_weight if "reward_dist" in info else info["x_position"]


def check(steps: list[Step]) -> None:
    wrong = [i for i, step in enumerate(steps) if step.terminated != step.gym_terminated]
    assert not wrong, f"terminated differs at steps {wrong}"
    for step in steps:
        assert relative_error(step.obs, step.gym_obs) <= 1e-5
        assert abs(step.eval - step.gym_eval) <= 1e-5 * max(1.0, abs(step.gym_eval))
        assert step.reward_error <= 1e-4
        for name, value in step.metrics.items():
            assert abs(value - step.info[name]) / step.reward_scale <= 1e-4, name


def trace(steps: list[Step]) -> list[tuple[Any, ...]]:
    """Return a fingerprint of the rollout in Gymnasium's environment."""
    return [(step.gym_obs.shape, step.gym_obs.sum(), step.gym_reward, step.gym_terminated) for step in steps]


def test_every_mujoco_environment_of_gymnasium_has_a_task() -> None:
    latest = [spec.id for spec in OWN.values() if spec.version == 5]
    assert len(latest) == 11
    assert sorted(latest) == sorted(IDS[task] for task in TASKS)


def test_every_gymnasium_id_of_a_task_is_registered() -> None:
    """A misspelt id would silently exclude a task from all comparisons."""
    assert not {name: id for name, id in IDS.items() if id not in gymnasium.registry}


@pytest.mark.parametrize("task", TASKS)
def test_many_steps_equal_those_of_gymnasium(task: str) -> None:
    pair = Pair(make_ours(task), make_theirs(task))
    assert pair.ours.timestep == pytest.approx(pair.theirs.dt, rel=1e-12)
    assert pair.ours.obs.shape == (1, *pair.theirs.observation_space.shape)
    assert np.array_equal(pair.ours.action_space.low, pair.theirs.action_space.low)
    assert np.array_equal(pair.ours.action_space.high, pair.theirs.action_space.high)
    horizon = OWN[IDS[task]].max_episode_steps
    assert find_task(task).horizon == horizon
    steps = pair.run(500, min(horizon, 200))
    check(steps)
    ends = sum(step.gym_terminated for step in steps)
    assert ends >= 5 if has(task, "terminated") else ends == 0


def test_force_at_the_end_of_the_rail_equals_that_of_gymnasium() -> None:
    pair = Pair(make_ours("inverted_double_pendulum"), make_theirs("inverted_double_pendulum"))

    def drive_to_the_end(data: mujoco.MjData) -> None:
        data.qpos[0], data.qvel[0] = pair.rng.choice([-1.0, 1.0]) * np.array([0.99, 0.05])

    forces = []
    for _ in range(20):
        pair.put(drive_to_the_end)
        steps = [pair.step() for _ in range(5)]
        check(steps)
        forces += [step.obs[8] for step in steps]
    assert min(forces) < 0.0 < max(forces) and np.mean(np.equal(forces, 0.0)) < 0.9
    assert any(0.0 < abs(force) < 10.0 for force in forces), "every force is clipped"


def test_pushed_cylinder_moves_as_in_gymnasium() -> None:
    """Place the cylinder beside the hand, because random actions hardly ever reach it."""
    pair = Pair(make_ours("pusher"), make_theirs("pusher"))
    model, (low, high) = pair.theirs.model, pair.theirs.model.jnt_range[:7].T

    def bring_together(data: mujoco.MjData) -> None:
        tips, cylinder = data.body("tips_arm").xpos, data.body("object").xpos
        while abs(tips[2] - cylinder[2]) > 0.03:
            data.qpos[:7] = pair.rng.uniform(low, high)
            mujoco.mj_kinematics(model, data)
        data.qpos[7:9] += (tips - cylinder)[1::-1]

    moved = []
    for _ in range(10):
        pair.put(bring_together)
        start = pair.theirs.data.qpos[7:9].copy()
        check([pair.step() for _ in range(10)])
        moved.append(np.linalg.norm(pair.theirs.data.qpos[7:9] - start))
    assert min(moved) > 5e-4  # the distance is in metres


HEALTHY = [task for task in TASKS if hasattr(unchanged(task), "is_healthy")]
RANGES = [(task, name) for task in HEALTHY for name in inspect.signature(unchanged(task)).parameters
          if name.startswith("healthy_") and name.endswith("_range")]  # fmt: skip


@pytest.mark.parametrize(("task", "bounded"), [*((task, None) for task in HEALTHY), *RANGES])
def test_terminal_states_are_those_of_gymnasium(task: str, bounded: str | None) -> None:
    wide = {name: (-1e6, 1e6) for other, name in RANGES if other == task and bounded not in (None, name)}
    if bounded is not None and math.isinf(max(keywords(task)[bounded])):
        wide[bounded] = (keywords(task)[bounded][0], 2.0)
    ours, theirs = make_ours(task, nworld=500, **wide), make_theirs(task, **wide)
    assert any(0.3 < share_of_ill_states(ours, theirs, 0.05 * 1.5**i) < 0.9 for i in range(25))


def share_of_ill_states(ours: lw.Env, theirs: Any, spread: float) -> float:
    """Compare the terminations of random states. Return the share of terminal states."""
    rng = np.random.default_rng(0)
    state = ours.get_state()
    parts = ours.state_space.split(state)
    qpos, qvel = parts["qpos"].numpy(), parts["qvel"].numpy()
    qpos[:] = np.float32(theirs.model.qpos0 + spread * rng.standard_normal(qpos.shape))
    qvel[:] = np.float32(theirs.init_qvel + spread * rng.standard_normal(qvel.shape))
    parts["done_reason"].zero_()
    ill = []
    for world in range(ours.nworld):
        theirs.data.qpos[:], theirs.data.qvel[:] = qpos[world], qvel[world]
        ill.append(not theirs.is_healthy)
    assert np.array_equal(ours.get_terminated(state).numpy(), ill)
    return float(np.mean(ill))


@pytest.mark.parametrize("task", TASKS)
def test_first_observation_equals_that_of_gymnasium_in_the_same_state(task: str) -> None:
    ours, theirs = make_ours(task, nworld=16), make_theirs(task)
    for start in (ours.rand_reset, ours.reset):
        start()
        state = ours.state_space.split(ours.get_state())
        for world in range(ours.nworld):
            mujoco.mj_resetData(theirs.model, theirs.data)
            theirs.set_state(state["qpos"][world].numpy(), state["qvel"][world].numpy())
            assert relative_error(ours.obs[world].numpy(), theirs._get_obs()) <= 1e-5
    assert np.array_equal(ours.field("qpos")[0].numpy(), theirs.init_qpos.astype(np.float32))
    assert np.array_equal(ours.field("qvel")[0].numpy(), theirs.init_qvel.astype(np.float32))
    assert not ours.terminated.any()


RESETS = [
    (task, times)
    for task in TASKS
    for times in (1.0, 3.0)
    if times == 1.0 or "reset_noise_scale" in inspect.signature(unchanged(task)).parameters
]


@pytest.mark.quick("1.0")
@pytest.mark.parametrize(("task", "times"), RESETS)
def test_random_resets_have_the_distribution_of_gymnasium(task: str, times: float) -> None:
    option = {} if times == 1.0 else {"reset_noise_scale": keywords(task)["reset_noise_scale"] * times}
    theirs, ours = make_theirs(task, **option), make_ours(task, nworld=250, **option)
    theirs.reset(seed=0)
    samples: list[list[np.ndarray]] = [[], []]
    for i in range(8):
        for _ in range(250):
            theirs.reset_model()
            samples[0].append(np.concatenate([theirs.data.qpos, theirs.data.qvel]))
        ours.rand_reset(i)
        state = ours.state_space.split(ours.get_state())
        samples[1].extend(torch.cat([state["qpos"], state["qvel"]], dim=1).numpy())
    start = np.concatenate([theirs.model.qpos0, theirs.init_qvel])
    check_same_distribution(np.array(samples[0]) - start, np.array(samples[1]) - start)


IGNORED = {("humanoid_standup", "uph_cost_weight")}
"""Parameters that Gymnasium 1.4 documents but ignores."""


@functools.cache
def keywords(task: str) -> dict[str, Any]:
    parameters = inspect.signature(unchanged(task)).parameters.values()
    others = ("xml_file", "default_camera_config")
    return {p.name: p.default for p in parameters if p.kind is not p.VAR_KEYWORD and p.name not in others}


def variants(default: Any) -> list[Any]:
    if isinstance(default, bool):
        return [not default]
    if isinstance(default, tuple):
        return [tuple(0.001 * bound for bound in default)]
    if isinstance(default, int):
        return [value for value in (3 * default, max(1, default // 3)) if value != default]
    return [2.5 * default, 0.3 * default]


PARAMETERS = [
    (task, name, variants(default))
    for task in TASKS
    for name, default in keywords(task).items()
    # other tests cover these parameters
    if name != "reset_noise_scale" and (task, name) not in RANGES
]


@functools.cache
def default_trace(task: str) -> list[tuple[Any, ...]]:
    return trace(Pair(make_ours(task, autoreset=True), make_theirs(task)).run(60))


@pytest.mark.parametrize("task", TASKS)
def test_every_gymnasium_parameter_exists_with_the_same_default(task: str) -> None:
    ours = make_ours(task)
    for name, default in keywords(task).items():
        if name == "frame_skip":
            assert find_task(task).frame_skip == default
        else:
            value = ours.task.parameters.values[name]
            np.testing.assert_array_equal(np.float32(value), np.float32(default), err_msg=name)
            assert isinstance(value, bool) == isinstance(default, bool), name


VALUES = [(task, name, value) for task, name, values in PARAMETERS for value in values]
VALUES.append(("ant", "main_body", "aux_3"))
DIFFERENT = [task for task in TASKS if task != "walker2d" and not task.startswith("humanoid")]
"""All tasks except those whose parameters resemble the hopper's or the ant's."""


@pytest.mark.quick(
    "ant-main_body-aux_3", *(f"{task}-{name}-{first}" for task, name, (first, *_) in PARAMETERS if task in DIFFERENT)
)
@pytest.mark.parametrize(("task", "name", "value"), VALUES, ids=["-".join(map(str, case)) for case in VALUES])
def test_parameter_has_the_same_effect_as_in_gymnasium(task: str, name: str, value: Any) -> None:
    pair = Pair(make_ours(task, autoreset=True, **{name: value}), make_theirs(task, **{name: value}))
    assert pair.ours.obs.shape == (1, *pair.theirs.observation_space.shape)
    assert pair.ours.timestep == pytest.approx(pair.theirs.dt, rel=1e-12)
    steps = pair.run(60)
    default, changed = default_trace(task), trace(steps)
    if (task, name) in IGNORED:
        assert changed == default, f"Gymnasium no longer ignores {name}: remove it from IGNORED"
        for step in steps:
            wanted = step.gym_reward + (value - 1.0) * step.info["reward_linup"]
            assert step.reward == pytest.approx(wanted, rel=1e-4)
        return
    assert changed != default, f"{name}={value} changes no number"
    check(steps)
