"""oracles/test_dm_control.py compares cartpole's rewards with dm_control's."""

import numpy as np
import torch
from checks import check_normal, check_uniform, positions
from conftest import SharedEnv

import lyceum_warp as lw


def put(env: lw.Env, qpos: np.ndarray) -> None:
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"].copy_(torch.from_numpy(qpos))
    parts["qvel"][:] = 0.0
    env.set_state(state)


def test_resets_start_with_a_nearly_upright_pole() -> None:
    env = lw.make("cartpole", engine="mujoco", nworld=2000)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_uniform(qpos / np.float32([0.1, 0.034]) / (1.0 + 1e-6))
    check_normal(qvel / 0.01)
    env.reset()
    assert not np.any(positions(env))


def test_task_succeeds_with_a_centred_cart_and_an_upright_pole(shared_env: SharedEnv) -> None:
    env = shared_env("cartpole", nworld=6, autoreset=False)
    upright, tilted = np.arccos(0.995) - 1e-4, np.arccos(0.995) + 1e-4
    put(env, np.array([[0, 0], [0.249, upright], [-0.249, -upright], [0.251, 0], [0, tilted], [0, np.pi]]))
    assert env.success.tolist() == [True, True, True, False, False, False]


def test_a_fallen_pole_does_not_end_the_episode(shared_env: SharedEnv) -> None:
    env = shared_env("cartpole", nworld=2, autoreset=False)
    put(env, np.array([[0.0, 0.5], [1.7, np.pi]]))
    for _ in range(60):
        env.step(torch.zeros(2, 1))
    assert env.eval[0] < 0.0, "the pole has not fallen"
    assert not env.done.any()
