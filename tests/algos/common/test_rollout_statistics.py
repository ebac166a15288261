import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos.common.rollout_statistics import gathered
from lyceum_warp.algos.npg import prediction_sums, value_statistics

NAMES = ("done", "episode_return", "episode_length", "reward", "eval", "success")


@pytest.fixture(scope="module")
def rollout() -> lw.Rollout:
    env = lw.make(Metered, nworld=6)
    rollout = lw.Rollout(env, 150)
    rollout.running_return[0] = math.nan  # episodes count only if their first steps were sampled
    generator = torch.Generator().manual_seed(1)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, log_std=0.0, generator=generator)
    rollout.collect(policy, torch.randn(rollout.action.shape, generator=torch.Generator().manual_seed(0)))
    rollout.faults[2] = 3
    return rollout


def statistics(rollout: lw.Rollout, *shares: slice) -> dict[str, Any]:
    """Gather the statistics of several processes. Each process has a slice of the worlds."""
    rows: list[torch.Tensor] = []

    def gather(row: torch.Tensor) -> torch.Tensor:
        rows.append(row)
        return torch.cat(rows)

    for worlds in shares:
        part: Any = SimpleNamespace(
            **{name: getattr(rollout, name)[:, worlds] for name in NAMES}, faults=rollout.faults[worlds],
            episode_metrics={name: sums[:, worlds] for name, sums in rollout.episode_metrics.items()},
            metrics={name: values[:, worlds] for name, values in rollout.metrics.items()},
        )  # fmt: skip
        found, _ = gathered(part, SimpleNamespace(gather=gather), {})  # type: ignore[arg-type]
    return found


def test_episode_statistics_cover_only_complete_episodes(rollout: lw.Rollout) -> None:
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
    metrics = {name: sums[ended].mean().item() for name, sums in rollout.episode_metrics.items()}
    assert list(metrics) == ["forward", "effort"] and metrics["effort"] > 0.1
    for shares in ([slice(None)], [slice(0, 1), slice(1, None)]):
        found = statistics(rollout, *shares)
        assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-5)
        assert found["metrics"] == pytest.approx(metrics, rel=1e-5)
    nothing = SimpleNamespace(**vars(rollout) | {"done": torch.zeros_like(rollout.done)})
    found = statistics(nothing, slice(None))  # type: ignore[arg-type]
    assert all(math.isnan(number) for number in (*(found[name] for name in expected), *found["metrics"].values()))


def test_step_statistics_cover_all_samples(rollout: lw.Rollout) -> None:
    steps = {name: values.mean().item() for name, values in rollout.metrics.items()}
    for count in (rollout.env.nworld, 1):  # a single process, then one process for each world
        found = statistics(rollout, *(slice(k, k + count) for k in range(0, rollout.env.nworld, count)))
        assert found["step_metrics"] == pytest.approx(steps, rel=1e-5)
        assert found["faults"] == 3 and found["reward_mean"] == pytest.approx(rollout.reward.mean().item())


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


def test_task_without_success_reports_no_success_rate() -> None:
    env = lw.make("hopper", nworld=2, horizon=10)
    config = lw.NPGConfig(samples=40, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)
    iteration = next(lw.NPG(env, config=config))
    assert math.isnan(iteration.success) and iteration.mean_success is None
    assert iteration.mean_return is not None and math.isfinite(iteration.return_mean)
