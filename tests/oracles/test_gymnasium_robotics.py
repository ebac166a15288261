"""The adroit_pen task against Gymnasium-Robotics' own environment, on the C engine."""

import dataclasses

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from checks import check_uniform
from conftest import SharedEnv
from gymnasium_robotics.envs.adroit_hand.adroit_pen import AdroitHandPenEnv
from gymnasium_robotics.utils.rotations import euler2quat

import lyceum_warp as lw

TIPS = {"C_rfdistal", "C_lfdistal"}


class Oracle(AdroitHandPenEnv):
    """Their environment without contacts of the target, and without a pair of fingertips that is listed twice there.

    The C engine makes two contacts of such a pair and MuJoCo Warp one, so the task leaves out the second entry.
    """

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(self.fullpath)
        spec.delete(next(pair for pair in spec.pairs if {pair.geomname1, pair.geomname2} == TIPS))
        spec.geom("target").contype = spec.geom("target").conaffinity = 0
        model = spec.compile()
        return model, mujoco.MjData(model)


UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@dataclasses.dataclass
class Step:
    """One step of both environments."""

    obs: np.ndarray
    gym_obs: np.ndarray
    reward: float
    gym_reward: float
    success: bool
    gym_goal: bool
    eval: float

    def check(self) -> None:
        """Compare, to the rounding of float32."""
        assert relative_error(self.obs, self.gym_obs) <= 1e-5
        assert relative_error(self.reward, self.gym_reward) <= 1e-5
        assert abs(self.eval - self.gym_obs[33:36] @ self.gym_obs[36:39]) <= 1e-6


def relative_error(ours: np.ndarray | float, theirs: np.ndarray | float) -> float:
    """Largest difference, relative to the larger of 1 and the value."""
    return float(np.max(np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs))))


class Pair:
    """One world and their environment, in the same states and under the same controls."""

    def __init__(self, ours: lw.Env, theirs: AdroitHandPenEnv, seed: int = 0) -> None:
        self.ours, self.theirs = ours, theirs
        self.theirs.reset(seed=seed)
        self.rng = np.random.default_rng(seed)
        self.apart = False
        self._simulate, self.theirs.do_simulation = self.theirs.do_simulation, self._with_our_controls

    def _with_our_controls(self, ctrl: np.ndarray, frames: int) -> None:
        # actions become controls in float32 here and in float64 there; over many steps the difference would show
        ours = self.ours.state_space.split(self.ours.get_state())["ctrl"][0].numpy()
        np.testing.assert_allclose(ours, ctrl, atol=2e-7)
        self._simulate(ours, frames)

    def put(self, target: np.ndarray = UPRIGHT, pen: np.ndarray | float = 0.0, noise: float = 0.05) -> None:
        """Put both near the initial state; every number is one of float32.

        The pen's body lies on its side: its first joint moves it down, its third along x.
        """
        model, data = self.theirs.model, self.theirs.data
        mujoco.mj_resetData(model, data)
        model.body("target").quat[:] = np.float32(target)
        low, high = model.jnt_range[:24].T
        data.qpos[:24] = np.float32(np.clip(self.rng.uniform(-noise, noise, 24), low, high))
        data.qpos[24:] = np.float32(pen)
        data.qvel[:] = np.float32(self.rng.uniform(-noise, noise, 30))
        mujoco.mj_forward(model, data)
        data.qacc_warmstart[:] = np.float32(data.qacc)
        self.apart = self.touched()

        state = self.ours.get_state()
        parts = self.ours.state_space.split(state[0])
        for name in ("qpos", "qvel", "qacc_warmstart", "xpos", "site_xpos"):
            parts[name].copy_(torch.from_numpy(np.ravel(getattr(data, name))))
        parts["mocap_quat"][-4:] = torch.from_numpy(np.float32(target))
        parts["memory"].zero_()
        self.ours.set_state(state)

    def pen_axis(self) -> np.ndarray:
        data = self.theirs.data
        return (data.site("object_top").xpos - data.site("object_bottom").xpos) / 0.13

    def point_target(self, away: float) -> None:
        """Turn the target so that its axis is an angle away from the pen's; both environments go on from there."""
        target, sideways = np.zeros(4), np.cross(self.pen_axis(), (0.0, 1.0, 0.0))
        axis = np.cos(away) * self.pen_axis() + np.sin(away) * sideways / np.linalg.norm(sideways)
        mujoco.mju_quatZ2Vec(target, axis)
        self.theirs.model.body("target").quat[:] = np.float32(target)
        mujoco.mj_forward(self.theirs.model, self.theirs.data)
        state = self.ours.get_state()
        parts = self.ours.state_space.split(state[0])
        parts["mocap_quat"][-4:] = torch.from_numpy(np.float32(target))
        for name in ("qacc_warmstart", "xpos", "site_xpos"):
            parts[name].copy_(torch.from_numpy(np.ravel(getattr(self.theirs.data, name))))
        self.ours.set_state(state)

    def step(self, action: np.ndarray) -> Step:
        action = action.astype(np.float32)
        self.ours.step(torch.from_numpy(action[None]))
        obs, reward, terminated, truncated, info = self.theirs.step(action.astype(np.float64))
        assert not terminated and not truncated and not self.ours.done.any()
        step = Step(
            self.ours.obs[0].numpy().astype(np.float64), obs, self.ours.reward.item(), float(reward),
            self.ours.success.item(), bool(info["success"]), self.ours.eval.item(),
        )  # fmt: skip
        self.apart |= self.touched()
        if not self.apart:
            step.check()
        return step

    def touched(self) -> bool:
        """Whether there is a contact that only their environment has; never with the oracle."""
        model = self.theirs.model
        touching = [{model.geom(geom).name for geom in pair} for pair in self.theirs.data.contact.geom]
        return touching.count(TIPS) > 1 or any("target" in names for names in touching)


@pytest.fixture
def ours(shared_env: SharedEnv) -> lw.Env:
    return shared_env("adroit_pen", autoreset=False, horizon=0, nthread=1)


@pytest.fixture
def pair(ours: lw.Env) -> Pair:
    return Pair(ours, Oracle())


def random_quat(rng: np.random.Generator) -> np.ndarray:
    return euler2quat([*rng.uniform(-1.0, 1.0, 2), 0.0])


def test_random_actions_lead_to_the_same_numbers(pair: Pair) -> None:
    """Four episodes, 400 steps, some actions out of range."""
    for _ in range(4):
        pair.put(random_quat(pair.rng))
        for i in range(100):
            if i % 4 == 0:
                action = pair.rng.uniform(-1.3, 1.3, 24)
            pair.step(action)


def test_the_registered_environment_agrees_until_contacts_differ(ours: lw.Env) -> None:
    """Until something touches the target, or those two fingertips touch each other."""
    theirs = gymnasium.make("AdroitHandPen-v1")
    assert theirs.spec is not None and theirs.spec.max_episode_steps == ours.task.task.horizon == 200
    pair = Pair(ours, theirs.unwrapped)
    checked = 0
    for _ in range(8):
        pair.put(random_quat(pair.rng))
        for i in range(50):
            if i % 4 == 0:
                action = pair.rng.uniform(-1.0, 1.0, 24)
            pair.step(action)
            checked += not pair.apart
    assert 100 < checked < 400


def test_bonuses_and_success_are_theirs(pair: Pair) -> None:
    """The bonuses are +10, +60 and -5. Success needs more than 20 steps at their goal, in a row or not."""
    seen: dict[float, int] = {}
    goals_at_once, successes = 0, 0
    for angle, height in ((0.1, 0.0), (0.38, 0.0), (0.1, -0.2), (2.0, -0.2), (0.1, 0.2)):
        pair.put(pen=np.array([-height, 0.0, 0.0, 0.0, 0.0, 0.0]))
        goals = 0
        for i in range(50):
            if i % 10 == 0:
                pair.point_target(angle if i < 40 else 1.0)
            step = pair.step(pair.rng.uniform(-0.2, 0.2, 24))
            goals += step.gym_goal
            assert step.success == (goals > 20)
            successes += step.success
            goals_at_once = max(goals_at_once, goals)
            bonus = round(step.gym_reward - step.eval + float(np.linalg.norm(step.gym_obs[39:42])), 3)
            seen[bonus] = seen.get(bonus, 0) + 1
    assert seen.keys() == {0.0, 10.0, 60.0, -5.0} and min(seen.values()) >= 5, seen
    assert goals_at_once > 30 and 10 < successes < 100


def test_the_target_has_no_contacts(ours: lw.Env) -> None:
    """A pen inside the target is pushed out in their environment and falls through it in the task."""
    heights = []
    for theirs in (AdroitHandPenEnv(), Oracle()):
        pair = Pair(ours, theirs)
        pair.put(UPRIGHT, np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]), noise=0.0)
        assert pair.apart == (type(theirs) is AdroitHandPenEnv)
        steps = [pair.step(np.zeros(24)) for _ in range(10)]
        heights.append((steps[-1].obs[26], steps[-1].gym_obs[26]))
    assert abs(heights[0][0] - heights[0][1]) > 0.01 and heights[1][0] == pytest.approx(heights[1][1], abs=1e-6)


def test_model_is_theirs_except_for_the_target_and_a_doubled_pair(shared_env: SharedEnv) -> None:
    """Their environment resets the actuators' gains when it is made."""
    ours, theirs = shared_env("adroit_pen").model, AdroitHandPenEnv().model
    assert ours.npair == theirs.npair - 1
    for name in (
        "body_mass", "body_inertia", "body_pos", "body_ipos", "body_iquat", "dof_damping", "dof_armature",
        "dof_frictionloss", "jnt_range", "jnt_margin", "geom_size", "geom_friction", "geom_margin",
        "tendon_range", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange",
    ):  # fmt: skip
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
    for name in ("timestep", "integrator", "cone", "solver", "iterations", "noslip_iterations"):
        assert getattr(ours.opt, name) == getattr(theirs.opt, name), name
    # the task reads none of the model's 65 sensors, so they are turned off
    assert ours.nsensor == theirs.nsensor == 65
    assert ours.opt.disableflags == theirs.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_SENSOR
    assert ours.opt.noslip_iterations == 20
    meshes = ours.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert meshes.any() and not ours.geom_contype[meshes].any() and not ours.geom_conaffinity[meshes].any()
    target = ours.geom_bodyid == ours.body("target").id
    assert target.any() and not ours.geom_contype[target].any() and not ours.geom_conaffinity[target].any()
    assert ours.body("target").mocapid[0] == 1, "the target is the second mocap body, not the first"


def test_spaces_are_theirs(pair: Pair) -> None:
    assert pair.ours.obs.shape == (1, *pair.theirs.observation_space.shape) == (1, 45)
    assert np.array_equal(pair.ours.action_space.low, pair.theirs.action_space.low)
    assert np.array_equal(pair.ours.action_space.high, pair.theirs.action_space.high)
    assert list(pair.ours.action_space.parts) == [pair.theirs.model.actuator(i).name for i in range(24)]
    assert pair.ours.timestep == pytest.approx(pair.theirs.dt, rel=1e-12)


# resets


def quats(env: lw.Env) -> np.ndarray:
    """The targets' orientations."""
    return env.state_space.split(env.get_state())["mocap_quat"][:, 4:].numpy().copy()


@pytest.mark.usefixtures("freed")
@pytest.mark.parametrize("scale", [None, 0.2])
def test_random_resets_turn_the_target_as_theirs_do(scale: float | None) -> None:
    """Hand and pen start where the model puts them; each world draws a target of its own."""
    env = lw.make("adroit_pen", engine="mujoco", nworld=2000, **({} if scale is None else {"target_range": scale}))
    found = quats(env)
    euler = 2.0 * np.arctan2(found[:, 1:3], found[:, [0, 0]])  # both half angles are under a right angle
    np.testing.assert_allclose(euler2quat(np.concatenate([euler, np.zeros((2000, 1))], axis=1)), found, atol=1e-6)
    check_uniform(euler / (scale or 1.0) / (1.0 + 1e-6))
    theirs = AdroitHandPenEnv()
    wanted, _ = theirs.reset(seed=0)
    for w in range(20):
        theirs.model.body("target").quat[:] = found[w]
        theirs.set_state(theirs.init_qpos, theirs.init_qvel)
        assert relative_error(env.obs[w].numpy().astype(np.float64), theirs._get_obs()) <= 1e-6
    assert len(np.unique(env.obs[:, 36:39].numpy().round(5), axis=0)) > 1900
    env.reset()
    assert np.array_equal(quats(env), np.tile(UPRIGHT, (2000, 1)))
    wanted[36:39], wanted[42:45] = (0.0, 0.0, 1.0), wanted[33:36] - (0.0, 0.0, 1.0)
    assert relative_error(env.obs.numpy().astype(np.float64), np.tile(wanted, (2000, 1))) <= 1e-6


def test_their_reset_draws_two_angles_in_the_order_of_the_axes() -> None:
    """The target's orientation is ``euler2quat`` of these angles."""
    env = AdroitHandPenEnv()
    env.reset(seed=3)
    angles = np.random.default_rng(3).uniform(-1, 1, 2)
    np.testing.assert_allclose(env.model.body("target").quat, euler2quat([*angles, 0.0]), atol=1e-12)
