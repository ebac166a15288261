"""Compare tasks with EnvPool's versions of dm_control's suite, on the C engine.

``store_envpool.py`` stored steps of EnvPool 1.2.5, which has MuJoCo 3.6.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw

DATA = Path(__file__).parent.parent / "data" / "envpool_suite.npz"
Parts = Mapping[str, np.ndarray]


@functools.cache
def stored() -> dict[str, np.ndarray]:
    with np.load(DATA) as file:
        return {f"dm/{key}": file[key] for key in file.files if "/" in key}


def tasks() -> list[str]:
    return list(dict.fromkeys(key.rpartition("/")[0] for key in stored()))


QUICK = ("dm/finger_turn_easy", "dm/walker_walk")
EVERY = [pytest.param(task, marks=() if task in QUICK else pytest.mark.long) for task in tasks()]


def acrobot(parts: Parts) -> np.ndarray:
    sines, cosines = np.split(parts["orientations"], 2, axis=1)
    upper, lower = np.arctan2(sines, cosines).T
    return np.stack([upper, lower - upper], 1)


def cartpole(parts: Parts) -> np.ndarray:
    x, cosine, sine = parts["position"].T
    return np.stack([x, np.arctan2(sine, cosine)], 1)


def pendulum(parts: Parts) -> np.ndarray:
    cosine, sine = parts["orientation"].T
    return np.arctan2(sine, cosine)[:, None]


def finger(parts: Parts) -> np.ndarray:
    x, z = parts["position"][:, 2:].T
    return np.column_stack([parts["position"][:, :2], np.arctan2(-x, z)])


def walker(parts: Parts) -> np.ndarray:
    cosines, sines = parts["orientations"].reshape(-1, 7, 2).transpose(2, 0, 1)
    torso, *legs = np.arctan2(sines, cosines).T
    right, left = ([torso - thigh, thigh - leg, leg - foot] for thigh, leg, foot in (legs[:3], legs[3:]))
    joints = np.remainder(np.column_stack([*right, *left]) + np.pi, 2.0 * np.pi) - np.pi
    return np.column_stack([parts["height"] - 1.3, np.zeros_like(torso), torso, joints])


def without_x(parts: Parts) -> np.ndarray:
    return np.column_stack([np.zeros(len(parts["position"])), parts["position"]])


QPOS: Mapping[str, Callable[[Parts], np.ndarray]] = {
    "acrobot": acrobot, "cartpole": cartpole, "cheetah": without_x, "finger": finger, "hopper": without_x,
    "pendulum": pendulum, "walker": walker,
}  # fmt: skip
"""Functions that compute joint positions from observations. Other domains observe the joint positions themselves."""


def set_states(env: lw.Env, domain: str, observation: np.ndarray) -> None:
    state = env.get_state()
    parts = {name: observation[:, part] for name, part in env.obs_space.parts.items()}
    fields = env.state_space.split(state)
    qpos = QPOS[domain](parts) if domain in QPOS else parts["position"]
    fields["qpos"].copy_(torch.from_numpy(qpos))
    fields["qvel"].copy_(torch.from_numpy(parts["velocity"]))
    fields["qacc_warmstart"].zero_()
    if "target_position" in parts:
        hinge = env.model.body("spinner").pos
        fields["mocap_pos"][:, ::2] = torch.from_numpy(parts["target_position"] + hinge[::2])
    if "to_target" in parts:
        fields["mocap_pos"].zero_()
        finger = -env.get_obs(state)[:, env.obs_space.parts["to_target"]]
        fields["mocap_pos"][:, :2] = finger + torch.from_numpy(parts["to_target"])
    env.set_state(state)


@pytest.mark.parametrize("task", EVERY)
def test_a_step_has_envpools_observations_and_rewards(shared_env: SharedEnv, task: str) -> None:
    before, action, after, reward = (
        stored()[f"{task}/{name}"] for name in ("observation", "action", "next_observation", "reward")
    )
    env = shared_env(task, nworld=len(before), autoreset=False)
    domain = env.task.definition.__module__.rpartition(".dm_")[2]
    set_states(env, domain, before)
    touch = env.obs_space.parts.get("touch", slice(0))
    columns = np.delete(np.arange(env.obs_space.size), touch)  # touch sensors keep the values of the last substep
    np.testing.assert_allclose(env.get_obs()[:, columns], before[:, columns], rtol=1e-6, atol=1e-6)
    env.action.copy_(torch.from_numpy(action))
    if domain == "finger":  # MuJoCo 3.6 computes contacts with solimp[0] = 0 differently
        set_states(env, domain, after.astype(float))
        found, rewards = env.get_obs(), env.get_reward(env.get_state(), env.action, env.get_state())
    else:
        env.step()
        found, rewards = env.obs, env.reward
    np.testing.assert_allclose(found[:, columns], after[:, columns], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rewards, reward, rtol=1e-6, atol=1e-6)
