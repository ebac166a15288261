import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw


@pytest.fixture
def g1(shared_env: SharedEnv) -> lw.Env:
    return shared_env("g1_velocity", nworld=8, autoreset=False, push_seconds=(1e6, 1e6))


def clock(env: lw.Env) -> torch.Tensor:
    return env.obs_space.split(env.obs)["clock"].clone()


def test_gait_clock_turns_at_the_gait_frequency(g1: lw.Env) -> None:
    g1.rand_reset(seed=0)
    begin = clock(g1)
    angle = 2.0 * np.pi * g1.task.params["gait_frequency"] * g1.timestep
    for _ in range(5):
        g1.step(torch.zeros(8, 12))
    turned = torch.atan2(*clock(g1).T) - torch.atan2(*begin.T)
    np.testing.assert_allclose(torch.remainder(turned, 2.0 * np.pi), np.full(8, 5 * angle), atol=1e-5)
    assert begin[:, 0].std() > 0.3, "worlds start at different phases"


def test_gait_clock_reward_is_the_share_of_feet_that_follow_the_clock(g1: lw.Env) -> None:
    g1.rand_reset(seed=0)
    state = g1.get_state()
    parts = g1.state_space.split(state)
    parts["standing"][:], parts["drawn_velocity"][:, 0] = 0.0, 1.0
    g1.set_state(state)
    seen = set()
    for _ in range(20):
        g1.step(0.3 * torch.randn(8, 12))
        cycles = torch.atan2(*clock(g1).T) / (2.0 * torch.pi)
        contact = g1.obs_spaces["critic"].split(g1.obs_groups["critic"])["foot_contact"] > 0.0
        stands = torch.stack([(cycles + 0.5 * foot) % 1.0 < g1.task.params["stance_share"] for foot in range(2)], 1)
        share = g1.metrics["gait_clock"] / (g1.timestep * g1.task.definition.rewards["gait_clock"])
        np.testing.assert_allclose(share, (stands == contact).float().mean(1), atol=1e-5)
        seen |= set(share.mul(2).round().tolist())
    assert seen == {0.0, 1.0, 2.0}


def test_costs_of_fast_motion_grow_with_the_number_of_steps_of_a_world(g1: lw.Env) -> None:
    action = torch.linspace(-0.2, 0.2, 12).repeat(8, 1)
    costs = []
    for steps in (0.0, 1000.0, 4000.0, 9000.0):
        g1.rand_reset(seed=0)
        state = g1.get_state()
        g1.state_space.split(state)["env_steps"][:] = steps
        g1.set_state(state)
        g1.step(action)
        costs.append(g1.metrics["growing_action_rate_l2"][0].item())
    np.testing.assert_allclose(np.array(costs) / costs[2], [1 / 4000, 0.25025, 1.0, 1.0], rtol=1e-3)
