import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos.npg_statistics import prediction_sums, value_statistics
from lyceum_warp.algos.rollout_statistics import (
    EpisodeSums,
    episode_statistics,
    finished,
    metric_means,
    metric_sums,
)

NAMES = ("done", "episode_return", "episode_length", "reward", "eval", "success")


def floats(sums: EpisodeSums) -> EpisodeSums:
    return EpisodeSums(*(number.item() for number in sums))


@pytest.fixture(scope="module")
def rollout() -> lw.Rollout:
    env = lw.make(Metered, nworld=6)
    rollout = lw.Rollout(env, 150)
    rollout.running_return[0] = math.nan  # an episode does not count if its first steps were not sampled
    generator = torch.Generator().manual_seed(1)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, log_std=0.0, generator=generator)
    rollout.collect(policy, torch.randn(rollout.action.shape, generator=torch.Generator().manual_seed(0)))
    return rollout


def part_of(rollout: lw.Rollout, worlds: slice) -> Any:
    return SimpleNamespace(
        **{name: getattr(rollout, name)[:, worlds] for name in NAMES},
        episode_metrics={name: sums[:, worlds] for name, sums in rollout.episode_metrics.items()},
        metrics={name: values[:, worlds] for name, values in rollout.metrics.items()},
    )


def test_episode_statistics_cover_only_complete_episodes(rollout: lw.Rollout) -> None:
    """The statistics of a rollout equal the pooled statistics of two subsets of its worlds."""
    ended = rollout.done & ~rollout.episode_return.isnan()
    assert 6 < ended.sum() < rollout.done.sum()
    returns = rollout.episode_return[ended].double()
    tensors = {
        "return_mean": returns.mean(), "return_std": returns.std(correction=0), "return_min": returns.min(),
        "return_max": returns.max(), "length_mean": rollout.episode_length[ended].mean(),
        "terminal_reward": rollout.reward[ended].mean(), "eval_mean": rollout.eval[ended].mean(),
        "success": rollout.success[ended].float().mean(),
    }  # fmt: skip
    expected = {name: tensor.item() for name, tensor in tensors.items()}
    assert episode_statistics([floats(finished(rollout))]) == pytest.approx(expected, rel=1e-5)
    parts = [floats(finished(part_of(rollout, worlds))) for worlds in (slice(0, 1), slice(1, None))]
    assert parts[0].episodes < parts[1].episodes
    assert episode_statistics(parts) == pytest.approx(expected, rel=1e-5)


def test_value_statistics_of_two_processes_equal_those_of_all_samples() -> None:
    returns, predicted = 3.0 + torch.randn(2, 50, dtype=torch.float64), 2.0 + torch.randn(2, 50, dtype=torch.float64)
    sums = [
        {name: number.item() for name, number in prediction_sums(*pair).items()}
        for pair in zip(returns, predicted, strict=True)
    ]
    error = returns - predicted
    assert value_statistics(sums, 50) == pytest.approx(
        {
            "value_error": (error.square().sum() / returns.square().sum()).item(),
            "explained_variance": (1.0 - error.var() / returns.var()).item(),
        }
    )


def test_metric_means_cover_only_complete_episodes(rollout: lw.Rollout) -> None:
    """The means of a rollout equal the pooled means of two subsets of its worlds, or NaN without episodes."""
    ended = rollout.done & ~rollout.episode_return.isnan()
    expected = {name: sums[ended].mean().item() for name, sums in rollout.episode_metrics.items()}
    assert list(expected) == ["forward", "effort"] and expected["effort"] > 0.1

    def means(*shares: slice) -> dict[str, Any]:
        parts = [part_of(rollout, worlds) for worlds in shares]
        sums = [[number.item() for number in metric_sums(part)] for part in parts]
        return metric_means(sum(finished(part).episodes.item() for part in parts), sums, list(expected))

    for shares in ([slice(None)], [slice(0, 1), slice(1, None)]):
        assert means(*shares)["metrics"] == pytest.approx(expected, rel=1e-5)
    steps = {name: values.mean().item() for name, values in rollout.metrics.items()}
    for count in (rollout.env.nworld, 1):  # one process for all worlds, and one process per world
        shares = [slice(k, k + count) for k in range(0, rollout.env.nworld, count)]
        assert means(*shares)["step_metrics"] == pytest.approx(steps, rel=1e-5)
    assert all(math.isnan(mean) for mean in metric_means(0.0, [[0.0] * 4], list(expected))["metrics"].values())


def test_metrics_row_has_a_column_for_each_metric() -> None:
    env = lw.make(Metered, nworld=4)
    config = lw.NPGConfig(samples=400, hidden=(8,), value_hidden=(8,), mean_every=0)
    it = next(lw.NPG(env, config=config))
    assert list(it.metrics) == ["forward", "effort"]
    assert it.return_mean == pytest.approx(it.metrics["forward"] - 0.1 * it.metrics["effort"], abs=1e-5)
    row = it.row()
    assert it.reward_mean == pytest.approx(it.step_metrics["forward"] - 0.1 * it.step_metrics["effort"], abs=1e-6)
    wanted = ["metrics/forward", "metrics/effort", "step_metrics/forward", "step_metrics/effort"]
    assert "metrics" not in row and list(row)[-4:] == wanted
    assert row["metrics/effort"] == it.metrics["effort"] and row["return_mean"] == it.return_mean


def test_mean_reward_covers_all_samples_even_if_no_episode_ended() -> None:
    env = lw.make("point_mass", nworld=4, horizon=1000)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=40, rollout="segments", hidden=(4,), value_hidden=(4,)))
    assert next(npg).reward_mean == pytest.approx(npg.rollout.reward.mean().item())


def test_task_without_success_reports_no_success_rate() -> None:
    env = lw.make("hopper", nworld=2, horizon=10)
    config = lw.NPGConfig(samples=40, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)
    iteration = next(lw.NPG(env, config=config))
    assert math.isnan(iteration.success) and iteration.mean_success is None
    assert iteration.mean_return is not None and math.isfinite(iteration.return_mean)
