import math

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw


@pytest.mark.parametrize("graphs", [True, False])
def test_rollout_buffer_stores_inputs_and_results_of_each_step(graphs: bool) -> None:
    env, plain = (lw.make(Metered, nworld=3, horizon=4, seed=2, graphs=g) for g in (graphs, True))
    rollout = lw.Rollout(env, 6, groups=("critic",))
    policy = lw.GaussianPolicy(1, 1, generator=torch.Generator().manual_seed(0))
    noise = torch.randn(rollout.action.shape, generator=torch.Generator().manual_seed(0))
    rollout.collect(policy, noise)
    assert list(rollout.obs_groups) == list(rollout.final_obs_groups) == ["policy", "critic"]
    assert rollout.obs_groups["policy"] is rollout.obs and list(lw.Rollout(env, 2).obs_groups) == ["policy"]
    assert rollout.final_obs_groups["critic"].shape == (6, 3, 2)
    for t in range(6):
        assert torch.equal(rollout.step[t], plain.episode_step.float())
        for name, obs in plain.obs_groups.items():
            assert torch.equal(rollout.obs_groups[name][t], obs)
        policy.sample(plain.obs, noise[t], out=plain.action)
        assert torch.equal(rollout.action[t], plain.action)
        plain.step()
        for name in ("final_obs", "reward", "eval", "terminated", "done", "success"):
            assert torch.equal(getattr(rollout, name)[t], getattr(plain, name))
        for name, obs in plain.final_obs_groups.items():
            assert torch.equal(rollout.final_obs_groups[name][t], obs)
        for name, sums in plain.episode_metrics.items():
            assert torch.equal(rollout.episode_metrics[name][t], sums)
    assert rollout.episode_length[:, 0].tolist() == [1, 2, 3, 4, 1, 2]
    torch.testing.assert_close(rollout.episode_return[3], rollout.reward[:4].sum(0))
    torch.testing.assert_close(rollout.running_return, rollout.reward[4:].sum(0))
    torch.testing.assert_close(rollout.episode_metrics["effort"][5], rollout.action.square().sum(-1)[4:].sum(0))


def test_option_first_only_counts_one_episode_per_world() -> None:
    env = lw.make("hopper", nworld=8)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    noise = torch.randn(200, 8, 3, generator=torch.Generator().manual_seed(0))
    counted = []
    for first_only in (False, True):
        rollout = lw.Rollout(env, 200, first_only=first_only)
        env.rand_reset(0)
        rollout.collect(policy, noise)
        counted.append(rollout.done & ~rollout.episode_return.isnan())
    every, first = counted
    assert (every.sum(0) > 1).all() and (first.sum(0) == 1).all()
    assert torch.equal(first.int().argmax(0), every.int().argmax(0))


def test_faults_within_a_rollout_are_counted() -> None:
    env = lw.make("hopper", nworld=3)
    rollout = lw.Rollout(env, 4)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    noise = torch.zeros(rollout.action.shape)
    noise[1:3, 2] = math.nan
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 2]
    # a fault counts as truncation, because learners bootstrap after it
    assert rollout.done[1, 2] and not rollout.terminated.any()
    assert env.fault_counts["action"] == 2
    noise.zero_()
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 0]


class Settling(Metered):
    settle = 2


@pytest.mark.parametrize(("task", "engine", "spread"), [
    (Metered, "warp", True), (Settling, "mujoco", True), (Settling, "warp", False),
])  # fmt: skip
def test_episodes_are_staggered_unless_the_warp_engine_settles_initial_states(
    task: type[lw.Task], engine: str, spread: bool
) -> None:
    rollout = lw.Rollout(lw.make(task, nworld=4, horizon=50, engine=engine), 1)
    rollout.restart()
    rollout.stagger(torch.Generator().manual_seed(0))
    assert bool((rollout.env.episode_step > 0).any()) == spread
