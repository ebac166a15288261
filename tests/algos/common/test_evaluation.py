import math

import numpy as np
import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos import evaluation_seed


def test_evaluate_counts_the_same_number_of_episodes_in_every_world() -> None:
    env = lw.make("hopper", nworld=4, horizon=60)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    counts: list[tuple[int, int]] = []
    got = lw.evaluate(env, policy, 8, seed=3, progress=lambda *now: counts.append(now))
    assert not env.action.requires_grad and counts == [(50, 120), (100, 120)]
    env.rand_reset(evaluation_seed(3))
    total, lengths, expected = torch.zeros(4), [0] * 4, [[] for _ in range(4)]
    while min(map(len, expected)) < 2:
        with torch.no_grad():
            env.step(policy(env.obs))
        total += env.reward
        for w in range(4):
            lengths[w] += 1
            if env.done[w]:
                expected[w].append((total[w].item(), lengths[w], env.eval[w].item()))
                total[w], lengths[w] = 0.0, 0
    flat = [episodes[i] for i in range(2) for episodes in expected]
    np.testing.assert_allclose(got.returns, [e[0] for e in flat], rtol=1e-5)
    np.testing.assert_array_equal(got.lengths, [e[1] for e in flat])
    np.testing.assert_allclose(got.evals, [e[2] for e in flat], rtol=1e-5)


def test_evaluate_returns_the_metrics_of_each_episode() -> None:
    env = lw.make(Metered, nworld=3)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    got = lw.evaluate(env, policy, 6, seed=3)
    assert list(got.metrics) == ["forward", "effort"]
    expected = got.metrics["forward"] - 0.1 * got.metrics["effort"]
    torch.testing.assert_close(got.returns, expected, rtol=0.0, atol=1e-5)
    assert got.returns.std() > 0.1
    few = got.first(2)
    assert torch.equal(few.returns, got.returns[:2])
    assert torch.equal(few.metrics["effort"], got.metrics["effort"][:2])
    point_mass = lw.make("point_mass", horizon=3)
    assert lw.evaluate(point_mass, lw.GaussianPolicy(6, 2), 1).metrics == {}


def test_evaluate_needs_automatic_resets_and_a_horizon() -> None:
    policy = lw.GaussianPolicy(6, 2)
    with pytest.raises(ValueError, match="autoreset=True"):
        lw.evaluate(lw.make("point_mass", autoreset=False), policy, 1)
    with pytest.raises(ValueError, match="give make.. a horizon"):
        lw.evaluate(lw.make("point_mass", horizon=0), policy, 1)


def test_mean_policy_is_evaluated_with_the_current_parameters_of_each_world() -> None:
    env = lw.make("point_mass", nworld=4, horizon=12, success_distance=[0.0, 9.0, 0.0, 9.0])
    config = lw.NPGConfig(samples=320, hidden=(8, 8), value_hidden=(16,), mean_every=1, mean_episodes=6)
    npg = lw.NPG(env, config=config)
    assert next(npg).mean_success == 0.5
    env.set_params(success_distance=9.0)
    it = next(npg)
    assert it.mean_success == it.success == 1.0


def test_mean_policy_is_evaluated_over_1000_steps_if_the_task_has_no_horizon() -> None:
    env = lw.make("half_cheetah", nworld=2, horizon=0)
    config = lw.NPGConfig(samples=20, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)
    iteration = next(lw.NPG(env, config=config))
    assert iteration.mean_length == 1000 and iteration.mean_return is not None
    assert math.isnan(iteration.return_mean) and math.isfinite(iteration.reward_mean)
