"""The buffer of NPG's samples."""

import math

import torch

import lyceum_warp as lw


def test_collect_stores_inputs_and_results_of_each_step() -> None:
    """The same with graphs, which are captured in the second step, and without."""
    stored = []
    for graphs in (True, False):
        env, plain = (
            lw.make("point_mass", nworld=3, horizon=4, seed=2, **options) for options in ({"graphs": graphs}, {})
        )
        rollout = lw.Rollout(env, 6)
        generator = torch.Generator().manual_seed(0)
        policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, generator=generator)
        noise = torch.randn(rollout.action.shape, generator=generator)
        rollout.collect(policy, noise)
        for t in range(6):
            assert torch.equal(rollout.obs[t], plain.obs) and torch.equal(rollout.step[t], plain.episode_step.float())
            policy.sample(plain.obs, noise[t], out=plain.action)
            assert torch.equal(rollout.action[t], plain.action)
            plain.step()
            for name in ("final_obs", "reward", "eval", "terminated", "done", "success"):
                assert torch.equal(getattr(rollout, name)[t], getattr(plain, name))
        assert rollout.episode_length[:, 0].tolist() == [1, 2, 3, 4, 1, 2]
        torch.testing.assert_close(rollout.episode_return[3], rollout.reward[:4].sum(0))
        torch.testing.assert_close(rollout.running_return, rollout.reward[4:].sum(0))
        stored.append(rollout.obs)
    assert torch.equal(*stored)


def test_faults_within_a_rollout_are_counted() -> None:
    env = lw.make("hopper", nworld=3)
    rollout = lw.Rollout(env, 4)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    noise = torch.zeros(rollout.action.shape)
    noise[1:3, 2] = math.nan
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 2]
    assert env.fault_counts["action"] == 2
    noise.zero_()
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 0]
