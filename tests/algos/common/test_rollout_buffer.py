import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos.common.rollout_statistics import gathered


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
            objects={name: held[:, worlds] for name, held in rollout.objects.items()},
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
    nothing = SimpleNamespace(**vars(rollout) | {"done": torch.zeros_like(rollout.done), "objects": {}})
    found = statistics(nothing, slice(None))  # type: ignore[arg-type]
    assert all(math.isnan(number) for number in (*(found[name] for name in expected), *found["metrics"].values()))


def test_step_statistics_cover_all_samples(rollout: lw.Rollout) -> None:
    steps = {name: values.mean().item() for name, values in rollout.metrics.items()}
    for count in (rollout.env.nworld, 1):  # a single process, then one process for each world
        found = statistics(rollout, *(slice(k, k + count) for k in range(0, rollout.env.nworld, count)))
        assert found["step_metrics"] == pytest.approx(steps, rel=1e-5)
        assert found["faults"] == 3 and found["reward_mean"] == pytest.approx(rollout.reward.mean().item())


def test_task_without_success_reports_no_success_rate() -> None:
    env = lw.make("hopper", nworld=2, horizon=10)
    config = lw.NPGConfig(samples=40, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)
    iteration = next(lw.NPG(env, config=config))
    assert math.isnan(iteration.success) and iteration.mean_success is None
    assert iteration.mean_return is not None and math.isfinite(iteration.return_mean)
