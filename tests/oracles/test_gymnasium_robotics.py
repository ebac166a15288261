"""Every task that names an environment of Gymnasium-Robotics, against that environment, on the C engine.

A task names it in its attribute ``gymnasium``. A new one needs nothing here; entries in SPECIAL reach its bonuses.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import load_env_creator

import lyceum_warp as lw
from lyceum_warp.binding.registry import find_task, task_names

gymnasium.register_envs(gymnasium_robotics)

IDS = {name: find_task(name).gymnasium for name in task_names()}
ENTRIES = {
    name: str(spec.entry_point)
    for name, id in IDS.items()
    if (spec := gymnasium.registry.get(id or "")) and str(spec.entry_point).startswith("gymnasium_robotics.")
}
TASKS = sorted(ENTRIES)

PARAMETERS: dict[str, dict[str, dict[str, Any]]] = {
    "reward_type": {"dense": {}, "sparse": {"sparse": True}},
}
"""Values of the parameters of their environments, and the task's parameters with the same meaning."""


def relative_error(ours: np.ndarray | float, theirs: np.ndarray | float) -> float:
    """Largest difference, relative to the larger of 1 and the value."""
    return float(np.max(np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs))))


@functools.cache
def oracle_class(name: str) -> type[MujocoEnv]:
    """Their environment, on their model with the changes that the task makes."""
    registered: Any = load_env_creator(ENTRIES[name])

    class Oracle(registered):  # type: ignore[misc]
        def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
            spec = mujoco.MjSpec.from_file(self.fullpath)
            find_task(name).edit_model(spec)
            model = spec.compile()
            return model, mujoco.MjData(model)

    return Oracle


class Pair:
    """One world and their environment, in the same states and under the same controls.

    Args:
        ours: The world.
        theirs: Their environment.
    """

    def __init__(self, ours: lw.Env, theirs: Any) -> None:
        self.ours, self.theirs = ours, theirs
        self.theirs.reset(seed=0)
        self.rng = np.random.default_rng(0)
        self.goals = 0
        """Steps of the episode in which their goal was achieved."""
        self._simulate, self.theirs.do_simulation = self.theirs.do_simulation, self._with_our_controls

    def _with_our_controls(self, ctrl: np.ndarray, frames: int) -> None:
        # actions become controls in float32 here and in float64 there; over many steps the difference would show
        ours = self.ours.state_space.split(self.ours.get_state())["ctrl"][0].numpy()
        np.testing.assert_allclose(ours, ctrl, atol=2e-7)
        self._simulate(ours, frames)

    def reset(self) -> None:
        """Begin an episode in the random initial state of ours."""
        self.ours.rand_reset()
        first = self.ours.obs[0].numpy().astype(np.float64)
        self.put()
        assert relative_error(first, self.theirs._get_obs()) <= 1e-5
        self.goals = 0

    def put(self, **values: np.ndarray) -> None:
        """Put both into our state, some of whose fields are replaced first."""
        model, data = self.theirs.model, self.theirs.data
        mujoco.mj_resetData(model, data)
        state = self.ours.get_state()
        parts = self.ours.state_space.split(state[0])
        for field, value in values.items():
            parts[field].copy_(torch.from_numpy(np.float32(np.ravel(value))))
        for field in ("qpos", "qvel"):
            getattr(data, field)[:] = parts[field].numpy()
        for body in moved_bodies(self.ours.model):
            i = self.ours.model.body(body).mocapid[0]
            self._move(body, parts["mocap_pos"].numpy()[3 * i :][:3], parts["mocap_quat"].numpy()[4 * i :][:4])
        mujoco.mj_forward(model, data)
        # the fields that a task reads as the engine's last step left them
        for field, part in parts.items():
            if hasattr(data, field) and not field.startswith("mocap") and np.size(getattr(data, field)) == len(part):
                part.copy_(torch.from_numpy(np.ravel(getattr(data, field)).astype(np.float64)))
        self.ours.set_state(state)

    def _move(self, body: str, pos: np.ndarray, quat: np.ndarray) -> None:
        """Place a body that is a mocap body in our model; in theirs it may be a fixed body, or just a site."""
        model, data = self.theirs.model, self.theirs.data
        if (id := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)) < 0:
            model.site(body).pos[:] = pos
        elif (mocap := model.body_mocapid[id]) < 0:
            model.body_pos[id], model.body_quat[id] = pos, quat
        else:
            # what their own reset has drawn for the model
            model.site_pos[:], model.body_pos[:] = self.ours.model.site_pos, self.ours.model.body_pos
            data.mocap_pos[mocap], data.mocap_quat[mocap] = pos, quat

    def step(self, action: np.ndarray, check: bool = True) -> float:
        """Step both and compare, to the rounding of float32; returns the reward."""
        action = action.astype(np.float32)
        self.ours.step(torch.from_numpy(action[None]))
        obs, reward, terminated, truncated, info = self.theirs.step(action.astype(np.float64))
        assert not truncated and not self.ours.truncated.any()
        self.goals += bool(info["success"])
        if check:
            assert relative_error(self.ours.obs[0].numpy().astype(np.float64), obs) <= 1e-5
            assert relative_error(self.ours.reward.item(), float(reward)) <= 1e-5
            assert self.ours.terminated.item() == terminated
            # a task may ask for several steps at the goal
            needed = getattr(self.ours.task.params, "goal_steps", None)
            assert self.ours.success.item() == (info["success"] if needed is None else self.goals > needed)
        return float(reward)

    def random_action(self, reach: float) -> np.ndarray:
        return self.rng.uniform(-reach, reach, self.theirs.model.nu)


def moved_bodies(model: mujoco.MjModel) -> list[str]:
    """The names of the mocap bodies."""
    return [model.body(i).name for i in range(model.nbody) if model.body_mocapid[i] >= 0]


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest) -> str:
    return str(request.param)


MakePair = Callable[..., Pair]


@pytest.fixture
def make_pair(task: str, shared_env: SharedEnv) -> MakePair:
    def make(theirs: type[MujocoEnv] | None = None, keywords: dict[str, Any] | None = None, **params: Any) -> Pair:
        ours = shared_env(task, autoreset=False, horizon=0, nthread=1, **params)
        return Pair(ours, (theirs or oracle_class(task))(**keywords or {}))

    return make


def test_random_actions_lead_to_the_same_numbers(make_pair: MakePair) -> None:
    """Five episodes of 200 steps from random initial states; a quarter of the actions is out of range."""
    pair = make_pair()
    for _ in range(5):
        pair.reset()
        for i in range(200):
            if i % 4 == 0:
                action = pair.random_action(1.3)
            pair.step(action)
