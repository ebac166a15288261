import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, positions
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.engines.warp.sizes import probe_sizes

OPEN, CLOSED = -1.0, 0.7
LOW = -1.0  # the gripper surrounds the ball on the floor at this height


def vertices(env: lw.Env) -> np.ndarray:
    data, found = mujoco.MjData(env.model), []
    for qpos in positions(env)[0]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        mujoco.mj_flex(env.model, data)
        found.append(data.flexvert_xpos.copy())
    return np.array(found)


def hold(env: lw.Env, steps: int, *action: float) -> None:
    for _ in range(steps):
        env.step(torch.tensor([action]).expand_as(env.action).contiguous())


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_gripper_squeezes_the_ball_and_lifts_it_to_the_target(shared_env: SharedEnv, engine: str) -> None:
    env = shared_env("soft_ball", engine=engine, nworld=1, autoreset=False)
    env.reset()
    hold(env, 20, 0.0, LOW, OPEN)
    free = vertices(env)[0]
    hold(env, 20, 0.0, LOW, CLOSED)
    hold(env, 60, 0.0, -0.1, CLOSED)
    ball = vertices(env)[0]
    assert 0.003 < np.ptp(free[:, 0]) - np.ptp(ball[:, 0]) < 0.02
    assert np.ptp(ball[:, 2]) > np.ptp(free[:, 2])
    assert free.mean(axis=0)[2] < 0.05 and abs(ball.mean(axis=0)[2] - 0.2) < 0.03
    assert env.success.all() and not env.terminated.any()
    assert env.eval.item() < 0.03 and env.metrics["near"] > 0.9 and env.metrics["lifted"] > 0.9


def test_observation_and_reward_agree_with_formulas_in_terms_of_vertices(shared_env: SharedEnv) -> None:
    env = shared_env("soft_ball", nworld=8, autoreset=False)
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.step(torch.from_numpy(rng.uniform(-1.0, 1.0, (8, 3)).astype(np.float32)))
    (qpos, qvel), points = positions(env), vertices(env)
    ball, widths = points.mean(axis=1), np.ptp(points, axis=1)
    velocity = qvel[:, 4:].reshape(8, 8, 3).mean(axis=1)
    grip = np.stack([qpos[:, 0], np.zeros(8), 0.05 + qpos[:, 1]], axis=1)
    target = env.state_space.split(env.get_state())["mocap_pos"].numpy()
    check_formula(
        env.obs, np.concatenate([qpos[:, :3], qvel[:, :3], ball, velocity, widths, grip - ball, target - ball], axis=1)
    )

    def fall(distance: np.ndarray, margin: float) -> np.ndarray:
        return 0.1 ** (np.maximum(distance - 0.01, 0.0) / margin) ** 2

    away = np.linalg.norm(target - ball, axis=1)
    near, lifted = fall(np.linalg.norm(grip - ball, axis=1), 0.2), fall(away, 0.3)
    check_formula(env.eval, away)
    check_formula(env.reward, near * (0.25 + 0.75 * lifted) - (1.0 - widths[:, 0] / 0.09) ** 2)


@pytest.mark.parametrize("axis", range(3))
def test_a_crushed_or_lost_ball_ends_the_episode(shared_env: SharedEnv, axis: int) -> None:
    """Squeeze the ball to 80 % and 60 % of its width along an axis, or move it by 0.3 and 0.45 m."""
    env = shared_env("soft_ball", nworld=4, autoreset=False)
    env.reset()
    corners = np.array([env.model.body(f"ball_{i // 4}_{i // 2 % 2}_{i % 2}").pos for i in range(8)])
    state = env.get_state()
    qpos = env.state_space.split(state)["qpos"]
    along = torch.arange(4 + axis, 28, 3)
    qpos[0, along] -= torch.from_numpy(0.2 * corners[:, axis])
    qpos[1, along] -= torch.from_numpy(0.4 * corners[:, axis])
    qpos[2, along] += 0.3
    qpos[3, along] += 0.45
    assert env.get_terminated(state).tolist() == [False, True, False, True]


def test_random_resets_place_ball_and_target(shared_env: SharedEnv) -> None:
    env = shared_env("soft_ball", nworld=64)
    ball, widths = env.obs[:, 6:9].numpy(), env.obs[:, 12:15].numpy()
    target = ball + env.obs[:, 18:21].numpy()
    assert np.ptp(widths, axis=0).max() < 1e-6
    np.testing.assert_allclose(ball[:, 1:], np.tile([0.0, 0.053], (64, 1)), atol=1e-3)
    for values, low, high in ((ball[:, 0], -0.2, 0.2), (target[:, 0], -0.2, 0.2), (target[:, 2], 0.15, 0.3)):
        assert low <= values.min() + 1e-6 and values.max() - 1e-6 <= high and np.ptp(values) > 0.8 * (high - low)
    assert abs(np.corrcoef(ball[:, 0], target[:, 0])[0, 1]) < 0.4


def test_constraint_buffers_of_a_flex_model_hold_bursts_of_contacts(shared_env: SharedEnv) -> None:
    """Fingers that press into the ball cause twice as many constraints as the probe for buffer sizes measures."""
    model = shared_env("soft_ball").model
    assert probe_sizes(model) >= (256, 512)
    env = shared_env("soft_ball", engine="warp", nworld=4, autoreset=False)
    env.reset()
    hold(env, 10, 0.0, 1.0, CLOSED)
    hold(env, 25, 0.0, LOW, CLOSED)
    assert not any(env.fault_counts.values())
