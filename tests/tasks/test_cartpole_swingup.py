"""The tasks whose models and rewards are written here: against dm_control's model and Lyceum's formulas."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import lyceum_warp as lw

SharedEnv = Callable[..., lw.Env]

# cartpole's physics


@pytest.fixture(scope="module")
def dm_cartpole() -> mujoco.MjModel:
    """dm_control's cartpole, read from its file: dm_control itself is not imported."""
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        pytest.skip("dm_control, whose cartpole.xml is the reference, is not installed: pip install dm_control")
    return mujoco.MjModel.from_xml_path(str(Path(package.submodule_search_locations[0], "suite", "cartpole.xml")))


def test_cartpole_model(shared_env: SharedEnv, dm_cartpole: mujoco.MjModel) -> None:
    """Masses, inertias, joints and motor are dm_control's."""
    ours, theirs = shared_env("cartpole_swingup").model, dm_cartpole
    for name in (
        "body_mass", "body_inertia", "body_pos", "body_ipos", "body_iquat",
        "jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_solref", "jnt_solimp", "jnt_stiffness",
        "dof_damping", "dof_armature", "dof_frictionloss",
        "actuator_gear", "actuator_ctrlrange", "actuator_ctrllimited", "actuator_gainprm", "actuator_biasprm",
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, atol=1e-12, err_msg=name)
    for name in ("timestep", "integrator", "gravity", "solver", "viscosity", "density"):
        assert np.array_equal(getattr(ours.opt, name), getattr(theirs.opt, name)), name
    contacts = mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert ours.opt.disableflags & contacts == theirs.opt.disableflags & contacts == contacts


@pytest.mark.parametrize("hold", [1, 25])
def test_cartpole_trajectory(shared_env: SharedEnv, dm_cartpole: mujoco.MjModel, hold: int) -> None:
    """500 steps of the same random controls lead both models along the same trajectory.

    Controls that are held for long drive the cart against both ends of the rail.
    """
    ours, theirs = shared_env("cartpole_swingup").model, dm_cartpole
    rng = np.random.default_rng(hold)
    a, b = mujoco.MjData(ours), mujoco.MjData(theirs)
    a.qpos[:] = b.qpos[:] = rng.uniform(-1.0, 1.0, 2) * (1.0, np.pi)
    a.qvel[:] = b.qvel[:] = rng.uniform(-1.0, 1.0, 2)
    cart = []
    for i in range(500):
        if i % hold == 0:
            a.ctrl[:] = b.ctrl[:] = rng.uniform(-1.5, 1.5, 1)
        mujoco.mj_step(ours, a)
        mujoco.mj_step(theirs, b)
        np.testing.assert_allclose(a.qpos, b.qpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.qvel, b.qvel, rtol=0, atol=1e-9)
        cart.append(a.qpos[0])
    if hold > 1:
        assert min(cart) < -1.7 and max(cart) > 1.7


# Lyceum's formulas in NumPy; the pole's direction comes from MuJoCo's rotation matrix, not from its angle


def tolerance(x: np.ndarray, margin: float, value_at_margin: float = 0.1) -> np.ndarray:
    """dm_control's tolerance around zero with the quadratic sigmoid, as Lyceum uses it."""
    scaled = np.abs(x) / margin * np.sqrt(1.0 - value_at_margin)
    return np.where(scaled < 1.0, 1.0 - scaled**2, 0.0)


def pole_direction(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The zz and xz elements of the pole's rotation matrix in each world."""
    data, matrices = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        matrices.append(data.body("pole").xmat.reshape(3, 3).copy())
    return np.array(matrices)[:, 2, 2], np.array(matrices)[:, 0, 2]


def cartpole_reward(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> np.ndarray:
    upright = (pole_direction(model, qpos)[0] + 1.0) / 2.0
    centred = (1.0 + tolerance(qpos[:, 0], margin=2.0)) / 2.0
    small_control = (4.0 + tolerance(action[:, 0], margin=1.0, value_at_margin=0.0)) / 5.0
    small_velocity = (1.0 + tolerance(qvel[:, 1], margin=5.0)) / 2.0
    return upright * centred * small_control * small_velocity


def put_at_random(env: lw.Env, rng: np.random.Generator, position: float, velocity: float) -> torch.Tensor:
    """Put every world into a random state, and give the states."""
    state = env.get_state()
    parts = env.state_space.split(state)
    for name, size in (("qpos", position), ("qvel", velocity)):
        values = rng.uniform(-size, size, parts[name].shape).astype(np.float32)
        parts[name].copy_(torch.from_numpy(values))
    env.set_state(state)
    return state


def positions(env: lw.Env, state: torch.Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
    """qpos and qvel, of the worlds or of a state, in float64."""
    parts = env.state_space.split(env.get_state() if state is None else state)
    return parts["qpos"].numpy().copy(), parts["qvel"].numpy().copy()


def same(ours: torch.Tensor, formula: np.ndarray) -> None:
    np.testing.assert_allclose(ours.numpy(), formula, rtol=1e-6, atol=2e-6)


NWORLD = 256


def test_cartpole_formula(shared_env: SharedEnv) -> None:
    """Reward, evaluation and observation of cartpole_swingup are Lyceum's, at random states and actions.

    The states go beyond the rail and the margins, the actions beyond the control range: the cost of an
    action is that of the action as given.
    """
    env = shared_env("cartpole_swingup", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    for _ in range(5):
        before = put_at_random(env, rng, position=3.0, velocity=6.0)
        qpos, qvel = positions(env, before)
        zz, xz = pole_direction(env.model, qpos)
        same(env.obs, np.stack([qpos[:, 0], zz, xz, qvel[:, 0], qvel[:, 1]], axis=1))
        same(env.eval, zz)
        assert not env.reward.any() and not env.terminated.any()

        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 1)).astype(np.float32))
        env.step(action)
        qpos, qvel = positions(env)
        zz, xz = pole_direction(env.model, qpos)
        expected = cartpole_reward(env.model, qpos, qvel, action.numpy().astype(np.float64))
        assert (np.abs(qpos[:, 0]) > 2.1).any() and (np.abs(qvel[:, 1]) > 5.3).any()
        same(env.reward, expected)
        same(env.eval, zz)
        same(env.obs, np.stack([qpos[:, 0], zz, xz, qvel[:, 0], qvel[:, 1]], axis=1))
        assert not env.terminated.any()

    # a transition that no step has made: what counts is the state after it
    after = put_at_random(env, rng, position=3.0, velocity=6.0)
    same(
        env.get_reward(before, action, after),
        cartpole_reward(env.model, *positions(env, after), action.numpy().astype(np.float64)),
    )
    same(env.get_eval(after), pole_direction(env.model, positions(env, after)[0])[0])


def test_cartpole_best_reward(shared_env: SharedEnv) -> None:
    """Upright, centred, at rest and without control is worth exactly 1; hanging down, nothing."""
    env = shared_env("cartpole_swingup", nworld=2, autoreset=False)
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"][:] = torch.tensor([[0.0, 0.0], [0.0, np.pi]])
    parts["qvel"][:] = 0.0
    assert torch.allclose(env.get_reward(state, torch.zeros(2, 1), state), torch.tensor([1.0, 0.0]), atol=1e-6)


def point_mass_distance(qpos: np.ndarray) -> np.ndarray:
    return np.linalg.norm(qpos[:, :2] - qpos[:, 2:], axis=1)


def test_point_mass_formula(shared_env: SharedEnv) -> None:
    """Reward, evaluation, observation and success of point_mass are Lyceum's, at random states and actions."""
    env = shared_env("point_mass", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    for _ in range(5):
        before = put_at_random(env, rng, position=1.3, velocity=2.0)
        qpos, qvel = positions(env, before)
        same(env.obs, np.concatenate([qpos[:, :2], qvel[:, :2], qpos[:, 2:]], axis=1))
        same(env.eval, point_mass_distance(qpos))
        assert not env.reward.any()

        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 2)).astype(np.float32))
        env.step(action)
        qpos, qvel = positions(env)
        same(env.reward, 1.0 - point_mass_distance(qpos))
        same(env.eval, point_mass_distance(qpos))
        same(env.obs, np.concatenate([qpos[:, :2], qvel[:, :2], qpos[:, 2:]], axis=1))
        assert not env.terminated.any()

    after = put_at_random(env, rng, position=0.08, velocity=2.0)
    distance = point_mass_distance(positions(env, after)[0])
    same(env.get_reward(before, action, after), 1.0 - distance)
    same(env.get_eval(after), distance)
    assert np.array_equal(env.success.numpy(), distance < 0.05)
    assert 10 < env.success.sum() < NWORLD - 10


def test_point_mass_physics(shared_env: SharedEnv) -> None:
    """A push of 1 accelerates the agent by gear over mass and armature; the target stays where it is."""
    env = shared_env("point_mass", nworld=2, autoreset=False)
    env.reset()
    assert env.model.opt.timestep == env.timestep == 0.02
    assert not env.model.opt.gravity.any()
    assert np.array_equal(env.model.jnt_range, np.tile([-1.4, 1.4], (4, 1)))
    env.step(torch.tensor([[1.0, 0.0], [0.0, -3.0]]))  # -3 is clipped to -1
    qpos, qvel = positions(env)
    # one semi-implicit Euler step from rest, damping 0.1 taken implicitly
    speed = 0.02 * 4.0 / (0.3 + 0.01 + 0.02 * 0.1)
    np.testing.assert_allclose(qvel, [[speed, 0, 0, 0], [0, -speed, 0, 0]], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(qpos, [[0.02 * speed, 0, 1, 0], [0, -0.02 * speed, 1, 0]], rtol=1e-6, atol=1e-9)


# resets


def check_uniform(samples: np.ndarray) -> None:
    """Check that each column is U(-1, 1), and independent of the others."""
    n, k = samples.shape
    assert np.abs(samples).max() <= 1.0
    assert samples.max(axis=0).min() > 1.0 - 20.0 / n and samples.min(axis=0).max() < 20.0 / n - 1.0
    expected = (np.sort(samples, axis=0) + 1.0) / 2.0
    ranks = (np.arange(n)[:, None] + 0.5) / n
    assert np.abs(expected - ranks).max() < 2.6 / np.sqrt(n)
    assert np.abs(np.corrcoef(samples.T) - np.eye(k)).max() < 5.5 / np.sqrt(n)


def check_normal(samples: np.ndarray) -> None:
    """Check that each column is N(0, 1), and independent of the others."""
    n, k = samples.shape
    quantiles = torch.special.ndtr(torch.from_numpy(np.sort(samples, axis=0))).numpy()
    ranks = (np.arange(n)[:, None] + 0.5) / n
    assert np.abs(quantiles - ranks).max() < 2.6 / np.sqrt(n)
    assert np.abs(samples.std(axis=0) - 1.0).max() < 5.0 / np.sqrt(2.0 * n)
    assert np.abs(np.corrcoef(samples.T) - np.eye(k)).max() < 5.5 / np.sqrt(n)


@pytest.mark.parametrize("scale", [None, 0.3])
def test_cartpole_reset(scale: float | None) -> None:
    """A reset hangs the pole down at rest; a random one adds normal noise of 0.01 to everything."""
    options = {} if scale is None else {"reset_noise_scale": scale}
    env = lw.make("cartpole_swingup", engine="mujoco", nworld=2000, **options)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_normal(np.concatenate([qpos - (0.0, np.pi), qvel], axis=1) / (scale or 0.01))
    env.reset()
    qpos, qvel = positions(env)
    np.testing.assert_allclose(qpos, np.tile([0.0, np.pi], (2000, 1)), atol=1e-6)
    assert not qvel.any()


def test_point_mass_reset() -> None:
    """A reset puts the agent at the origin and the target at (1, 0); a random one draws both from the square."""
    env = lw.make("point_mass", engine="mujoco", nworld=2000)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_uniform(qpos)
    assert not qvel.any()
    env.reset()
    qpos, qvel = positions(env)
    assert np.array_equal(qpos, np.tile([0.0, 0.0, 1.0, 0.0], (2000, 1)))
    assert not qvel.any()
