"""Test the Adroit tasks. oracles/test_gymnasium_robotics.py compares them with the original tasks."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw

GOALS = {"adroit_hammer": "success_distance", "adroit_door": "success_angle", "adroit_relocate": "success_distance"}


@pytest.fixture(params=sorted(GOALS))
def task(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def steps(env: lw.Env, n: int = 5) -> None:
    rng = torch.Generator().manual_seed(0)
    for _ in range(n):
        env.step(2 * torch.rand(env.action.shape, generator=rng) - 1)


def test_metrics_sum_to_the_reward_and_the_palm_weight_changes_only_the_first(shared_env: SharedEnv, task: str) -> None:
    env, turned = (shared_env(task, nworld=4, nthread=1, palm_weight=weight) for weight in (0.1, -0.1))
    assert lw.MPPI(task, horizon=2, samples=2, nthread=1).env.task.params["palm_weight"] == -1.0
    for each in (env, turned):
        each.rand_reset(3)
        steps(each)
        torch.testing.assert_close(sum(each.metrics.values()), each.reward)
    first, *others = env.metrics
    assert (env.metrics[first] > 0.01).all()
    torch.testing.assert_close(turned.metrics[first], -env.metrics[first])
    for name in others:
        assert torch.equal(turned.metrics[name], env.metrics[name])


def test_task_succeeds_if_a_distance_is_below_its_threshold(task: str) -> None:
    env = lw.make(task, engine="mujoco", nworld=4, nthread=1)
    steps(env)
    assert not env.success.any()
    values = env.eval.numpy()
    moved = values + np.array([-1e-3, 1e-3, -1e-3, 1e-3])
    env.set_params(**{GOALS[task]: moved})
    env.set_state(env.get_state())
    assert env.success.tolist() == [False, True, False, True] if task != "adroit_door" else [True, False, True, False]


RANGES: dict[str, dict[str, Any]] = {
    "adroit_hammer": {"board_height": (0.2, 0.2)},
    "adroit_door": {"frame_low": (-0.1, 0.3, 0.3), "frame_high": (-0.1, 0.3, 0.3)},
    "adroit_relocate": {
        "ball_low": (0.1, 0.2), "ball_high": (0.1, 0.2), "target_low": (0, 0.1, 0.2), "target_high": (0, 0.1, 0.2),
    },
}  # fmt: skip


def test_resets_randomize_within_the_ranges_of_the_parameters(shared_env: SharedEnv, task: str) -> None:
    env = shared_env(task, nworld=2, nthread=1, **RANGES[task])
    place = {name: part[1].tolist() for name, part in env.state_space.split(env.get_state()).items()}
    moved = place["mocap_pos"][3:]
    if task == "adroit_hammer":
        assert moved == pytest.approx([0.05, 0.0, 0.2])
    elif task == "adroit_door":
        assert moved == pytest.approx([-0.1, 0.3, 0.3])
    else:
        assert moved == pytest.approx([0.0, 0.1, 0.2])
        assert place["qpos"][30:33] == pytest.approx([0.1, 0.2, 0.0])
        assert env.obs[1, 36:39].tolist() == pytest.approx([0.1, 0.1, -0.165], abs=1e-6)


def test_a_smaller_target_range_of_the_pen_gives_smaller_angles() -> None:
    env = lw.make("adroit_pen", engine="mujoco", nworld=200, target_range=np.linspace(0.01, 0.4, 200), seed=2)
    upright = env.obs[:, 38].numpy()  # the cosine of the tilt is the product of the cosines of two angles
    assert (upright >= np.cos(np.linspace(0.01, 0.4, 200)) ** 2 - 1e-6).all()
    assert 0.7 < upright.min() < 0.95
