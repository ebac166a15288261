"""Test adroit_pen. oracles/test_gymnasium_robotics.py compares it with the original task."""

import numpy as np
import torch

import lyceum_warp as lw


def formula(obs: np.ndarray, near: float, goal: float, reach: np.ndarray | float, drop: float) -> np.ndarray:
    distance = np.linalg.norm(obs[:, 39:42], axis=1)
    similarity = (obs[:, 33:36] * obs[:, 36:39]).sum(axis=1)
    reward = similarity - distance
    reward += 10.0 * ((distance < reach) & (similarity > near)) + 50.0 * ((distance < reach) & (similarity > goal))
    return reward - 5.0 * (obs[:, 26] < drop)


def test_every_threshold_changes_rewards_or_terminations() -> None:
    n = 400
    rng = np.random.default_rng(0)
    reach = rng.uniform(0.02, 0.2, n)
    env = lw.make(
        "adroit_pen", engine="mujoco", nworld=n, autoreset=False, nthread=1, near_similarity=0.3, goal_similarity=0.7,
        goal_distance=reach, drop_height=0.2, goal_steps=3,
    )  # fmt: skip
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"][:, 24:27] = torch.from_numpy(rng.uniform(-0.1, 0.1, (n, 3)))
    parts["qpos"][:, 27:] = torch.from_numpy(rng.uniform(-1.5, 1.5, (n, 3)))
    env.set_state(state)
    assert not env.reward.any()
    # new positions affect the reward only after a step
    counts, terms = np.zeros(n), set()
    for _ in range(6):
        env.step(torch.zeros(n, 24))
        obs = env.obs.numpy().astype(np.float64)
        wanted = formula(obs, 0.3, 0.7, reach.astype(np.float32), 0.2)
        np.testing.assert_allclose(env.reward.numpy(), wanted, rtol=1e-5, atol=1e-5)
        similarity = (obs[:, 33:36] * obs[:, 36:39]).sum(axis=1)
        np.testing.assert_allclose(env.eval.numpy(), similarity, atol=1e-6)
        counts += (np.linalg.norm(obs[:, 39:42], axis=1) < reach) & (similarity > 0.7)
        assert np.array_equal(env.success.numpy(), counts > 3)
        terms |= set(np.round(wanted - similarity + np.linalg.norm(obs[:, 39:42], axis=1)).tolist())
    assert terms == {-5.0, 0.0, 5.0, 10.0, 55.0, 60.0}
    assert 10 < env.success.sum() < n - 10


def test_a_smaller_target_range_gives_smaller_angles() -> None:
    env = lw.make("adroit_pen", engine="mujoco", nworld=200, target_range=np.linspace(0.01, 0.4, 200), seed=2)
    upright = env.obs[:, 38].numpy()  # the cosine of the tilt is the product of the cosines of two angles
    assert (upright >= np.cos(np.linspace(0.01, 0.4, 200)) ** 2 - 1e-6).all()
    assert 0.7 < upright.min() < 0.95


def test_target_has_no_contacts() -> None:
    env = lw.make("adroit_pen", engine="mujoco", nworld=2, nthread=1)
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"][:, 26] = 0.2
    parts["mocap_pos"][1, 3:] = 5.0
    env.set_state(state)
    for _ in range(10):
        env.step(torch.zeros(2, 24))
    assert torch.equal(env.obs[0, 24:33], env.obs[1, 24:33])
