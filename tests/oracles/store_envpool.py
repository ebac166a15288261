"""Run dm_control's tasks in EnvPool, and store observations, actions and rewards for test_envpool.py.

EnvPool computes in float64 with its own copies of the models and its own rewards. Run this script in a separate
virtual environment:

    python -m venv pool && pool/bin/pip install envpool==1.2.5
    pool/bin/python tests/oracles/store_envpool.py tests/data/envpool_suite.npz

A task is included if its states can be computed from its observations.
"""

import sys
from importlib.metadata import version
from typing import Any

import envpool
import numpy as np

TASKS = (
    "acrobot_swingup acrobot_swingup_sparse ball_in_cup_catch cartpole_balance cartpole_balance_sparse "
    "cartpole_swingup cartpole_swingup_sparse cheetah_run finger_spin finger_turn_easy finger_turn_hard hopper_stand "
    "hopper_hop pendulum_swingup point_mass_easy reacher_easy reacher_hard walker_stand walker_walk walker_run"
).split()
WORLDS, STEPS, EVERY = 4, 300, 15


def flat(observation: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.reshape(value, (WORLDS, -1)) for value in observation.values()], 1)


def stored(task: str) -> dict[str, Any]:
    """Return every fifteenth step of a task's worlds. Each random action lasts fifteen steps."""
    name = "".join(word.capitalize() for word in task.split("_"))
    env = envpool.make(f"{name}-v1", env_type="gymnasium", num_envs=WORLDS, num_threads=1, seed=1)
    rng, rows = np.random.default_rng(0), {"observation": [], "action": [], "next_observation": [], "reward": []}
    observation, _ = env.reset()
    for step in range(STEPS):
        if step % EVERY == 0:
            drawn = rng.uniform(env.action_space.low, env.action_space.high, (WORLDS, *env.action_space.shape))
            action = drawn.astype(np.float32)
        after, reward, *_ = env.step(action.astype(np.float64))
        if step % EVERY == EVERY // 2:
            values = flat(observation), action, flat(after).astype(np.float32), reward.astype(np.float32)
            for found, value in zip(rows.values(), values, strict=True):
                found.append(value)
        observation = after
    return {key: np.concatenate(value) for key, value in rows.items()} | {"parts": list(after)}


if __name__ == "__main__":
    arrays = {f"{task}/{key}": value for task in TASKS for key, value in stored(task).items()}
    np.savez_compressed(sys.argv[1], script="tests/oracles/store_envpool.py", versions=f"envpool {version('envpool')}",
                        **arrays)  # fmt: skip
