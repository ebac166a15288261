import unittest

import numpy as np
import pytest
import torch
from full_task import Full

import lyceum_warp as lw

dm_env = pytest.importorskip("dm_env")

from dm_env import test_utils  # noqa: E402

from lyceum_warp.adapters.dm_env import DmEnvironment  # noqa: E402


class TestOfDmEnv(test_utils.EnvironmentTestMixin, unittest.TestCase):
    def make_object_under_test(self) -> DmEnvironment:
        return DmEnvironment("hopper", horizon=6)


def test_step_types_discounts_and_values_follow_dm_env() -> None:
    env, twin = DmEnvironment("hopper", seed=3, horizon=4), lw.make("hopper", seed=3, horizon=4, autoreset=False)
    action = np.array([0.5, -0.5, 1.0], np.float32)
    twin.rand_reset()
    first = env.step(action)
    assert first.first() and first.reward is None and first.discount is None
    for _ in range(4):
        np.testing.assert_array_equal(np.concatenate(list(first.observation.values())), twin.obs[0])
        twin.action[0, :] = torch.from_numpy(action)
        twin.step()
        first = env.step(action)
        assert first.reward == twin.reward.item() and first.discount == 1.0
    assert first.last() and env.step(action).first()


def test_termination_has_discount_zero() -> None:
    env = DmEnvironment("hopper", healthy_angle_range=(-0.01, 0.01), seed=0)
    env.reset()
    step = next(step for step in (env.step(np.ones(3)) for _ in range(100)) if step.last())
    assert step.discount == 0.0


def test_observations_are_a_dict_of_parts_or_a_flat_array() -> None:
    env = DmEnvironment("hopper")
    assert {name: spec.shape for name, spec in env.observation_spec().items()} == {"position": (5,), "velocity": (6,)}
    flat = DmEnvironment(Full, flat_observation=True)
    (spec,) = flat.observation_spec().values()
    spec.validate(flat.reset().observation["observations"])
    assert flat.action_spec().shape == flat.env.action_space.shape
