import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, check_uniform, positions, put_at_random
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD = 64
SIDES = ("left", "right")

ARM = {  # ranges in rad and peak torques in N m, from Barrett D1001, tables 5 and 6; HERB turns the first joint by pi
    "j1": (np.pi - 2.6, np.pi + 2.6, 77.3),
    "j2": (-2.0, 2.0, 160.6),
    "j3": (-2.8, 2.8, 95.6),
    "j4": (-0.9, 3.1, 29.4),
    "j5": (-4.76, 1.24, 11.6),
    "j6": (-1.6, 1.6, 11.6),
    "j7": (-3.0, 3.0, 2.7),
}
FINGERS = {"j00": 180, "j10": 180, "j01": 140, "j11": 140, "j21": 140, "j02": 48, "j12": 48, "j22": 48}  # degrees


@pytest.mark.parametrize("side", SIDES)
def test_model_has_the_published_mass_limits_and_torques(shared_env: SharedEnv, side: str) -> None:
    model = shared_env("herb_reach").model
    assert (model.nq, model.nv, model.nu, model.nmocap) == (30, 30, 22, 2)
    np.testing.assert_allclose(model.body(f"{side}/wam_base").subtreemass, 30.7614869, atol=1e-6)
    for name, (low, high, torque) in ARM.items():
        np.testing.assert_allclose(model.joint(f"{side}/{name}").range, (low, high), err_msg=name)
        actuator = model.actuator(f"{side}/{name}")
        assert actuator.gear[0] == torque and np.array_equal(actuator.ctrlrange, [-1, 1])
        assert actuator.trnid[0] == model.joint(f"{side}/{name}").id
    for name, degrees in FINGERS.items():
        np.testing.assert_allclose(model.joint(f"{side}/{name}").range, (0, np.deg2rad(degrees)), err_msg=name)
    assert model.jnt_limited.all() and model.actuator_ctrllimited.all()


def test_arms_do_not_move_without_torque(shared_env: SharedEnv) -> None:
    """Gravity is compensated."""
    env = shared_env("herb_reach", nworld=2, autoreset=False)
    before = positions(env)[0]
    for _ in range(50):
        env.step(torch.zeros(2, 22))
    np.testing.assert_allclose(positions(env)[0], before, atol=1e-3)


def test_one_motor_moves_both_joints_of_a_finger(shared_env: SharedEnv) -> None:
    env = shared_env("herb_reach", nworld=1, autoreset=False)
    env.reset()
    action = torch.zeros(1, 22)
    action[0, 7:11] = 0.3  # spread, fingers 0, 1 and 2
    for _ in range(50):
        env.step(action)
    angle = {name: positions(env)[0][0, env.model.joint(f"left/{name}").qposadr[0]] for name in FINGERS}
    assert angle["j00"] > 1.0 and angle["j00"] == pytest.approx(angle["j10"], abs=0.05)
    for i in range(3):
        assert angle[f"j{i}1"] > 1.0 and angle[f"j{i}2"] == pytest.approx(angle[f"j{i}1"] * 45 / 140, abs=0.05)


def palms(env: lw.Env, qpos: np.ndarray) -> np.ndarray:
    data, found = mujoco.MjData(env.model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(env.model, data)
        found.append([data.site(f"{side}/palm").xpos.copy() for side in SIDES])
    return np.array(found)


def targets(env: lw.Env) -> np.ndarray:
    return env.state_space.split(env.get_state())["mocap_pos"].numpy().reshape(-1, 2, 3).copy()


def put_targets(env: lw.Env, offset: np.ndarray) -> None:
    """Stop the arms, and place targets beside the palms.

    ``offset`` is the distance along x in metres, (nworld, 2).
    """
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qvel"][:] = 0.0
    goals = palms(env, parts["qpos"].numpy())
    goals[..., 0] += offset
    parts["mocap_pos"].copy_(torch.from_numpy(goals.reshape(len(goals), 6)))
    env.set_state(state)


def test_task_functions_equal_their_formulas(shared_env: SharedEnv) -> None:
    env = shared_env("herb_reach", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    for near in (False, True):
        put_at_random(env, rng, position=1.0, velocity=0.5)
        if near:
            put_targets(env, rng.uniform(-0.06, 0.06, (NWORLD, 2)))
        action = torch.from_numpy(rng.uniform(-0.1, 0.1, (NWORLD, 22)).astype(np.float32))
        env.step(action)
        qpos, qvel = positions(env)
        palm, goal = palms(env, qpos), targets(env)
        distance = np.linalg.norm(goal - palm, axis=2)
        parts = (qpos, qvel, palm.reshape(-1, 6), (goal - palm).reshape(-1, 6))
        check_formula(env.obs, np.concatenate(parts, axis=1))
        check_formula(env.eval, distance.max(axis=1))
        terms = {
            "reaching": -distance.sum(axis=1),
            "precision": 0.5 * (0.1 ** ((distance / 0.05) ** 2)).sum(axis=1),
            "effort": -0.01 * (action.numpy().astype(np.float64) ** 2).sum(axis=1),
        }
        for name, term in terms.items():
            np.testing.assert_allclose(env.metrics[name].numpy(), term, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(env.reward.numpy(), sum(terms.values()), rtol=1e-5, atol=1e-5)
        assert not env.terminated.any()
        assert terms["precision"].max() > 0.3 or not near


@pytest.mark.usefixtures("freed")
def test_random_resets_keep_targets_and_arms_in_their_ranges() -> None:
    env = lw.make("herb_reach", engine="mujoco", nworld=2000)
    env.rand_reset(0)
    low, high = np.float32([0.6, 0.1, 0.7]), np.float32([0.95, 0.6, 1.3])
    goals = targets(env) * [[[1, 1, 1], [1, -1, 1]]]
    home = env.model.key("home").qpos
    qpos, qvel = positions(env)
    arms = np.r_[0:7, 15:22]
    drawn = [(2 * goals - low - high).reshape(-1, 6) / np.tile(high - low, 2), (qpos - home)[:, arms] / 0.1]
    check_uniform(np.concatenate(drawn, axis=1) / (1.0 + 1e-5))
    assert not np.delete(qpos - home, arms, axis=1).any() and not qvel.any()
    env.reset()
    np.testing.assert_allclose(positions(env)[0], np.tile(home, (2000, 1)), atol=1e-6)
    np.testing.assert_allclose(targets(env)[0], [[0.8, 0.35, 1.0], [0.8, -0.35, 1.0]], atol=1e-6)


def test_task_succeeds_after_ten_steps_with_both_hands_at_their_targets() -> None:
    env = lw.make("herb_reach", engine="mujoco", nworld=4, autoreset=False)
    offset = np.array([[0.0, 0.0], [0.06, 0.0], [0.0, 0.06], [0.045, -0.045]])
    put_targets(env, offset)
    for _ in range(10):
        assert not env.success.any()
        env.step(torch.zeros(4, 22))
    assert env.success.tolist() == [True, False, False, True]
    np.testing.assert_allclose(env.eval, np.abs(offset).max(axis=1), atol=2e-3)
