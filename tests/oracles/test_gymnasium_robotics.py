"""Compare tasks with their Gymnasium-Robotics environments on the C engine.

Add the special states of a new task to SPECIAL.
"""

import dataclasses
import functools
import inspect
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch
from checks import check_same_distribution
from conftest import SharedEnv
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import load_env_creator

import lyceum_warp as lw
from lyceum_warp.binding import find_task

gymnasium.register_envs(gymnasium_robotics)

IDS = {
    name: id
    for name in lw.task_names()
    if (id := find_task(name).gymnasium) and str(gymnasium.spec(id).entry_point).startswith("gymnasium_robotics.")
}
"""Map each task to the id of its Gymnasium-Robotics environment."""

pytestmark = pytest.mark.parametrize("task", IDS)


def relative_error(ours: np.ndarray | float, theirs: np.ndarray | float) -> float:
    return float(np.max(np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs))))


def geoms(pair: mujoco.MjsPair) -> set[str]:
    return {pair.geomname1, pair.geomname2}


@functools.cache
def oracle_class(name: str) -> type[MujocoEnv]:
    """Return Gymnasium-Robotics' class, but with the task's model and without duplicate contact pairs."""
    registered: Any = load_env_creator(gymnasium.spec(IDS[name]).entry_point)

    class Oracle(registered):  # type: ignore[misc]
        def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
            spec = mujoco.MjSpec.from_file(self.fullpath)
            find_task(name).edit_model(spec)
            for pair in [pair for i, pair in enumerate(spec.pairs) if geoms(pair) in map(geoms, spec.pairs[:i])]:
                spec.delete(pair)
            model = spec.compile()
            return model, mujoco.MjData(model)

    return Oracle


def registered(name: str) -> Any:
    return gymnasium.make(IDS[name], disable_env_checker=True).unwrapped


class Pair:
    def __init__(self, ours: lw.Env, theirs: Any) -> None:
        self.ours, self.theirs = ours, theirs
        self.places = {field: getattr(theirs.model, field).copy() for field in ("body_pos", "body_quat", "site_pos")}
        """Copies of model fields that random resets change."""
        self.theirs.reset(seed=0)
        self.rng = np.random.default_rng(0)
        self.goals = 0
        """Number of steps in which Gymnasium-Robotics reported success."""
        self._simulate, self.theirs.do_simulation = self.theirs.do_simulation, self._with_our_controls

    def _with_our_controls(self, ctrl: np.ndarray, frames: int) -> None:
        # both simulations get equal float32 controls, because rounding differences would grow over many steps
        ours = self.ours.state_space.split(self.ours.get_state())["ctrl"][0].numpy()
        np.testing.assert_allclose(ours, ctrl, atol=2e-7)
        self._simulate(ours, frames)

    def reset(self) -> None:
        self.ours.rand_reset()
        first = self.ours.obs[0].numpy().astype(np.float64)
        self.put()
        assert relative_error(first, self.theirs._get_obs()) <= 1e-5
        self.goals = 0

    def put(self, **values: np.ndarray) -> None:
        model, data = self.theirs.model, self.theirs.data
        for field, own in self.places.items():
            getattr(model, field)[:] = own
        mujoco.mj_resetData(model, data)
        state = self.ours.get_state()
        parts = self.ours.state_space.split(state[0])
        for field, value in values.items():
            parts[field].copy_(torch.from_numpy(np.float32(np.ravel(value))))
        for field in ("qpos", "qvel"):
            getattr(data, field)[:] = parts[field].numpy()
        pos, quat = parts["mocap_pos"].numpy().reshape(-1, 3), parts["mocap_quat"].numpy().reshape(-1, 4)
        for body, i in mocap_bodies(self.ours.model).items():
            self._move(body, pos[i], quat[i])
        mujoco.mj_forward(model, data)
        # lagged fields
        for field, part in parts.items():
            if hasattr(data, field) and not field.startswith("mocap") and np.size(getattr(data, field)) == len(part):
                part.copy_(torch.from_numpy(np.ravel(getattr(data, field)).astype(np.float64)))
        self.ours.set_state(state)

    def _move(self, body: str, pos: np.ndarray, quat: np.ndarray) -> None:
        """Place a mocap body.

        Gymnasium-Robotics may have a mocap body, a fixed body or a site with this name.
        """
        model, data = self.theirs.model, self.theirs.data
        if (id := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)) < 0:
            model.site(body).pos[:] = pos
        elif (mocap := model.body_mocapid[id]) < 0:
            model.body_pos[id], model.body_quat[id] = pos, quat
        else:
            data.mocap_pos[mocap], data.mocap_quat[mocap] = pos, quat

    def step(self, action: np.ndarray) -> None:
        action = action.astype(np.float32)
        self.ours.step(torch.from_numpy(action[None]))
        self.obs, self.reward, self.terminated, truncated, info = self.theirs.step(action.astype(np.float64))
        assert not truncated and not self.ours.truncated.any()
        self.success = bool(info["success"])
        self.goals += self.success

    def check(self) -> None:
        assert relative_error(self.ours.obs[0].numpy().astype(np.float64), self.obs) <= 1e-5
        assert relative_error(self.ours.reward.item(), float(self.reward)) <= 1e-5
        assert self.ours.terminated.item() == self.terminated
        # a task may require several steps at the goal
        steps = self.ours.task.params.get("goal_steps")
        assert self.ours.success.item() == (self.success if steps is None else self.goals > steps)

    def random_action(self, reach: float) -> np.ndarray:
        return self.rng.uniform(-reach, reach, self.theirs.model.nu)


def mocap_bodies(model: mujoco.MjModel) -> dict[str, int]:
    return {model.body(i).name: int(mocap) for i, mocap in enumerate(model.body_mocapid) if mocap >= 0}


@dataclasses.dataclass
class Special:
    """A state that random actions do not reach."""

    reward: float
    """Reward of the next step, with a tolerance of 0.1."""
    joints: dict[str, float]
    """Map names of joints to positions."""
    moved: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    """Map names of mocap bodies to poses."""

    def fields(self, env: lw.Env) -> dict[str, np.ndarray]:
        parts = env.state_space.split(env.get_state()[0])
        fields = {name: parts[name].numpy().copy() for name in ("qpos", "mocap_pos", "mocap_quat")}
        for joint, value in self.joints.items():
            fields["qpos"][env.model.joint(joint).qposadr] = value
        for body, pose in self.moved.items():
            i = mocap_bodies(env.model)[body]
            fields["mocap_pos"][3 * i :][:3], fields["mocap_quat"][4 * i :][:4] = pose[:3], pose[3:]
        return fields


def pen(reward: float, angle: float, up: float) -> Special:
    """Return a state with a given height of the pen and a given angle to the target."""
    turn = (np.pi / 2 - angle) / 2
    return Special(reward, {"OBJTx": -up}, {"target": (0.2, 0.2, 0.2, np.cos(turn), 0.0, np.sin(turn), 0.0)})


def ball(reward: float, up: float, aside: float) -> Special:
    """Return a state with a given height and lateral distance of the ball. The target is 0.2 m above the table."""
    joints = {"OBJTx": aside, "OBJTy": 0.0, "OBJTz": up - 0.035}
    return Special(reward, joints, {"target": (0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0)})


SPECIAL = {
    "adroit_door": [
        Special(reward, {"door_hinge": angle}) for reward, angle in ((-0.2, 0.1), (1.9, 0.3), (10.0, 1.1), (20.0, 1.4))
    ],
    "adroit_hammer": [
        Special(0.7, {"OBJTy": 0.15}),
        Special(24.4, {"nail_dir": 0.08}),
        Special(99.4, {"nail_dir": 0.09}),
    ],
    "adroit_pen": [pen(61.0, 0.1, 0.0), pen(10.9, 0.38, 0.0), pen(0.8, 0.1, 0.2), pen(-5.6, 2.0, -0.2)],
    "adroit_relocate": [ball(0.0, 0.035, 0.15), ball(0.8, 0.2, 0.15), ball(10.9, 0.2, 0.08), ball(30.9, 0.2, 0.01)],
}
"""Map each task to states in which it succeeds or gives a reward bonus."""


def make_pair(shared_env: SharedEnv, task: str, theirs: Any = None, **params: Any) -> Pair:
    """Pair a world with an original environment, or with the modified one."""
    ours = shared_env(task, autoreset=False, horizon=0, nthread=1, **params)
    return Pair(ours, theirs or oracle_class(task)())


@pytest.mark.quick("adroit_pen")
def test_results_under_random_actions_equal_gymnasium_robotics(shared_env: SharedEnv, task: str) -> None:
    pair = make_pair(shared_env, task)
    for _ in range(5):
        pair.reset()
        for i in range(200):
            if i % 4 == 0:
                action = pair.random_action(1.3)
            pair.step(action)
            pair.check()


def pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    return list(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True))


def test_task_agrees_with_the_unchanged_original_until_contacts_differ(shared_env: SharedEnv, task: str) -> None:
    pair = make_pair(shared_env, task, registered(task))
    ours, theirs = pair.ours.model, pair.theirs.model
    ghosts = set(np.flatnonzero(ours.geom_contype != theirs.geom_contype))
    doubled, checked = {pair for pair in pairs(theirs) if pairs(theirs).count(pair) > pairs(ours).count(pair)}, 0
    for _ in range(4):
        pair.reset()
        for i in range(50):
            if i % 4 == 0:
                action = pair.random_action(1.0)
            pair.step(action)
            touching = {(int(a), int(b)) for a, b in pair.theirs.data.contact.geom}
            if touching & doubled or any(ghosts.intersection(geoms) for geoms in touching):
                break
            pair.check()
            checked += 1
    assert checked >= 50


@pytest.mark.quick("dense")
@pytest.mark.parametrize("reward_type", ["dense", "sparse"])
def test_bonuses_and_success_equal_gymnasium_robotics(shared_env: SharedEnv, task: str, reward_type: str) -> None:
    pair = make_pair(shared_env, task, oracle_class(task)(reward_type=reward_type), sparse=reward_type == "sparse")
    assert task in SPECIAL, "add states that reach the bonuses and success"
    rewards, successes = set(), 0
    for special in SPECIAL[task]:
        pair.reset()
        pair.put(**special.fields(pair.ours))
        for i in range(30):
            pair.step(pair.random_action(0.2))
            pair.check()
            if i == 0 and reward_type == "dense":
                assert pair.reward == pytest.approx(special.reward, abs=0.1)
            rewards.add(pair.reward)
            successes += pair.ours.success.item()
    assert 0 < successes < 30 * len(SPECIAL[task])
    assert reward_type == "dense" or rewards == {10.0, -0.1}


def test_spaces_and_parameters_equal_gymnasium_robotics(shared_env: SharedEnv, task: str) -> None:
    ours, theirs = shared_env(task, autoreset=False, horizon=0, nthread=1), registered(task)
    low, high = theirs.action_space.low, theirs.action_space.high
    assert ours.obs.shape == (1, *theirs.observation_space.shape)
    assert np.array_equal(ours.action_space.low, low) and np.array_equal(ours.action_space.high, high)
    assert list(ours.action_space.parts) == [theirs.model.actuator(i).name for i in range(theirs.model.nu)]
    assert ours.timestep == pytest.approx(theirs.dt, rel=1e-12)
    assert find_task(task).horizon == gymnasium.spec(IDS[task]).max_episode_steps
    assert set(inspect.signature(type(theirs).__init__).parameters) == {"self", "reward_type", "kwargs"}


KINDS = {
    "body": mujoco.mjtObj.mjOBJ_BODY, "jnt": mujoco.mjtObj.mjOBJ_JOINT, "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE, "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR, "sensor": mujoco.mjtObj.mjOBJ_SENSOR, "dof": None, "wrap": None,
}  # fmt: skip
"""Map each kind of element to its MuJoCo type."""


def differences(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> set[tuple[str, str]]:
    found = set()
    for kind, named in KINDS.items():
        fields = [name for name in dir(theirs) if name.startswith(f"{kind}_")]
        for i in range(len(getattr(theirs, fields[0]))):
            name = mujoco.mj_id2name(theirs, named, i) if named else None
            k = mujoco.mj_name2id(ours, named, name) if name else i
            assert k >= 0, f"the model has no {kind} {name!r}"
            found |= {(f, name) for f in fields if not np.array_equal(getattr(ours, f)[k], getattr(theirs, f)[i])}
    return found


def test_model_equals_gymnasium_robotics_except_for_edits(shared_env: SharedEnv, task: str) -> None:
    ours, theirs = shared_env(task, autoreset=False, horizon=0, nthread=1).model, registered(task).model
    moved = mocap_bodies(ours)
    others = {(field, name) for field, name in differences(ours, theirs) if name not in moved}
    assert {field for field, _ in others} <= {"sensor_objid"}, others
    first = {pair: i for i, pair in reversed(list(enumerate(pairs(theirs))))}
    assert ours.npair == len(first)
    for field in ("solref", "solimp", "margin", "gap", "friction", "dim"):
        assert np.array_equal(
            getattr(ours, f"pair_{field}"), getattr(theirs, f"pair_{field}")[[first[pair] for pair in pairs(ours)]]
        )
    for name in ("timestep", "integrator", "cone", "solver", "iterations", "noslip_iterations", "tolerance"):
        assert getattr(ours.opt, name) == getattr(theirs.opt, name), name


def test_fixed_resets_give_the_initial_positions_of_the_model(shared_env: SharedEnv, task: str) -> None:
    pair = make_pair(shared_env, task, registered(task))
    pair.ours.reset()
    pair.put()
    for field, own in pair.places.items():
        np.testing.assert_allclose(getattr(pair.theirs.model, field), own, atol=1e-7)
    assert np.array_equal(pair.theirs.data.qpos, pair.theirs.init_qpos)
    assert np.array_equal(pair.theirs.data.qvel, pair.theirs.init_qvel)


@pytest.mark.usefixtures("freed")
def test_random_resets_have_the_distribution_of_gymnasium_robotics(task: str) -> None:
    n, m = 400, 1000
    env, original = lw.make(task, engine="mujoco", nworld=m, nthread=1), registered(task)
    ours = env.obs.numpy().astype(np.float64)
    theirs = np.array([original.reset(seed=None if i else 0)[0] for i in range(n)])
    check_same_distribution(theirs, ours)
