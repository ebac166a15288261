import dataclasses
from pathlib import Path
from typing import Any

import npg
import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos import Rollout


def case(contestant: str, **changes: Any) -> Any:
    found = npg.cases(npg.Options(short=True, contestants=(contestant,), threads=1))[0]
    return dataclasses.replace(found, samples=500, nworld=found.nworld and 4, **changes)


def row(contestant: str, seed: int, curve: list[Any], **result: Any) -> Any:
    samples, seconds, mean = curve[-1]
    made = case(contestant, seed=seed, task="hopper")
    found = {"samples": samples, "seconds": seconds, "mean_return": mean, "curve": curve}
    return npg.Row(dataclasses.asdict(made), found | result, {}, 1.0)


def test_rollouts_through_gymnasium_equal_rollouts_of_the_package() -> None:
    nworld, steps = 4, 60
    env = lw.make("hopper", nworld=nworld, seed=0, nthread=1)
    ours = Rollout(env, steps)
    ours.restart()
    ours.stagger(torch.Generator().manual_seed(0))
    envs = npg.vector("hopper", nworld, "sync")
    fed = npg.GymnasiumRollout(env, steps, envs, seed=0, segments=True)
    assert [single.get_wrapper_attr("_elapsed_steps") for single in envs.envs] == env.episode_step.tolist()
    state = env.get_state()
    for world, single in enumerate(envs.envs):
        parts = {name: state[world, env.state_space.parts[name]].numpy() for name in ("qpos", "qvel")}
        single.unwrapped.set_state(parts["qpos"], parts["qvel"])
        fed.now[world] = single.unwrapped._get_obs()
    policy = lw.GaussianPolicy(11, 3)
    noise = torch.randn(steps, nworld, 3, generator=torch.Generator().manual_seed(1))
    ours.collect(policy, noise)
    fed.collect(policy, noise)
    for world in range(nworld):
        ends = ours.done[:, world].nonzero()
        assert len(ends), "no episode ended in these steps, so no restart was compared"
        until = int(ends[0]) + 1
        for name in ("obs", "action", "final_obs", "reward", "step", "terminated", "done", "episode_length"):
            mine, theirs = (getattr(rollout, name)[:until, world] for rollout in (ours, fed))
            assert torch.allclose(mine.float(), theirs.float(), atol=1e-4), name
        assert torch.equal(ours.episode_return[:until, world].isnan(), fed.episode_return[:until, world].isnan())
    later = fed.done.cumsum(0).roll(1, 0) > 0
    assert not fed.episode_return[1:][later[1:]].isnan().any()


@pytest.mark.quick("npg")
@pytest.mark.parametrize("contestant", ["npg", "npg_gymnasium"])
def test_npg_run_returns_a_learning_curve(contestant: str) -> None:
    result = npg.measure(case(contestant), npg.Options(short=True))
    curve = result["curve"]
    assert [point[0] for point in curve] == [0, 500]
    assert 0.0 <= curve[0][1] < curve[1][1]
    assert np.isfinite([point[2] for point in curve]).all()
    assert 0 < result["sampling_seconds"] <= result["seconds"]
    assert (result.get("mode") in ("sync", "async")) == (contestant == "npg_gymnasium")


def test_learner_of_another_library_ends_after_its_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.setitem(npg.LIMITS, "ppo_sb3", 1e-2)
    result = npg.measure(dataclasses.replace(case("ppo_sb3"), samples=1_000_000), npg.Options(short=True))
    assert result["samples"] < 256 and [point[0] for point in result["curve"]] == [0, result["samples"]]


def test_npg_tables_and_figure_are_made_from_stored_results(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    rows = []
    for name, slower in (("npg", 1.0), ("npg_gymnasium", 3.0), ("ppo_sb3", 20.0)):
        for seed in range(5):
            returns = np.linspace(0.0, 3000.0, 21) * random.uniform(0.9, 1.1, 21)
            curve = [[50_000 * i, 2.0 * slower * i, value] for i, value in enumerate(returns)]
            rows.append(row(name, seed, curve, sampling_seconds=slower, mode="sync"))
    ends, agreement = npg.tables(rows)
    found = {line[1]: line for line in ends.rows}
    assert found["NPG, Gymnasium's environments (sync)"][7] == "3.00 (3.00 to 3.00)"
    assert len(agreement.rows) == 10 and "differ at 0 of 10 points" in agreement.title
    npg.figure(rows).savefig(tmp_path / "npg.png")
    npg.figure([rows[0], row("npg", 1, [[0, 0.0, 5.0], [50_000, 2.0, 9.0]])])
