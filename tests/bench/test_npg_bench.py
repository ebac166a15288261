"""The learning curves of NPG and of its peers, in the mechanics of their short mode."""

import contextlib
import dataclasses
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos.rollout_buffer import Rollout


@pytest.fixture
def npg(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "bench"))
    threads = torch.get_num_threads()
    import npg

    yield npg
    torch.set_num_threads(threads)


def case(npg: ModuleType, contestant: str, **changes: Any) -> Any:
    """The short mode's, with fewer samples."""
    found = npg.cases(npg.Options(short=True, contestants=(contestant,), threads=1))[0]
    return dataclasses.replace(found, samples=500, nworld=found.nworld and 4, **changes)


def row(npg: ModuleType, contestant: str, seed: int, curve: list[Any], **result: Any) -> Any:
    samples, seconds, mean, noisy = curve[-1]
    made = case(npg, contestant, seed=seed, task="hopper")
    found = {"samples": samples, "seconds": seconds, "mean_return": mean, "noisy_return": noisy, "curve": curve}
    return npg.Row(dataclasses.asdict(made), found | result, {}, 1.0)


def test_gymnasium_fills_the_buffer_with_the_numbers_of_our_environments(npg: ModuleType) -> None:
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
        assert len(ends), "no episode ended in these steps, so that this test shows too little"
        until = int(ends[0]) + 1  # the next episode begins elsewhere
        for name in ("obs", "action", "final_obs", "reward", "step", "terminated", "done", "episode_length"):
            mine, theirs = (getattr(rollout, name)[:until, world] for rollout in (ours, fed))
            assert torch.allclose(mine.float(), theirs.float(), atol=1e-4), name
        # the first, shortened episodes count in neither
        assert torch.equal(ours.episode_return[:until, world].isnan(), fed.episode_return[:until, world].isnan())
    later = fed.done.cumsum(0).roll(1, 0) > 0
    assert not fed.episode_return[1:][later[1:]].isnan().any()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasiums_first_episodes_are_as_short_as_ours(npg: ModuleType, mode: str) -> None:
    env = lw.make("swimmer", nworld=2, nthread=1)
    state = env.get_state()
    state[:, env.state_space.parts["step"]] = torch.tensor([[995.0], [998.0]], dtype=torch.float64)
    env.set_state(state)
    with contextlib.closing(npg.vector("swimmer", 2, mode)) as envs:
        fed = npg.GymnasiumRollout(env, 8, envs, seed=0, segments=True)
        fed.collect(lw.GaussianPolicy(8, 2), torch.zeros(8, 2, 2))
    assert fed.done.nonzero().tolist() == [[1, 1], [4, 0]] and not fed.terminated.any()
    assert fed.step[:, 0].tolist() == [995, 996, 997, 998, 999, 0, 1, 2]


@pytest.mark.parametrize("contestant", ["npg", "npg_gymnasium"])
def test_a_run_yields_a_curve(npg: ModuleType, contestant: str) -> None:
    result = npg.measure(case(npg, contestant), npg.Options(short=True))
    curve = result["curve"]
    assert [point[0] for point in curve] == [0, 500]
    assert 0.0 <= curve[0][1] < curve[1][1] and curve[0][3] is None
    assert np.isfinite([point[2] for point in curve]).all()
    assert 0 < result["sampling_seconds"] + result["update_seconds"] <= result["seconds"]
    assert (result.get("mode") in ("sync", "async")) == (contestant == "npg_gymnasium")


def test_ppo_of_stable_baselines3_yields_a_curve(npg: ModuleType) -> None:
    pytest.importorskip("stable_baselines3")
    result = npg.measure(case(npg, "ppo_sb3"), npg.Options(short=True))
    assert result["samples"] == 512 and [point[0] for point in result["curve"]] == [0, 256, 512]


def test_a_long_iteration_is_judged_once(npg: ModuleType) -> None:
    curve = npg.Curve(dataclasses.replace(case(npg, "npg"), judgements=10))
    curve.judge = lambda act: 0.0
    curve.start(lambda obs: obs)
    for samples in (40, 50, 60, 180, 190, 200, 500):
        if curve.due(samples):
            curve.add(samples, len)
    assert [point[0] for point in curve.points()] == [0, 50, 180, 200, 500]


def test_a_yardstick_ends_when_its_time_is_over(npg: ModuleType) -> None:
    pytest.importorskip("stable_baselines3")
    limited = dataclasses.replace(case(npg, "ppo_sb3"), samples=1_000_000, limit=1e-3)
    result = npg.measure(limited, npg.Options(short=True))
    assert result["samples"] < 256 and [point[0] for point in result["curve"]] == [0, result["samples"]]


def test_a_gpu_is_free_while_its_policies_are_judged(npg: ModuleType) -> None:
    policy = lw.GaussianPolicy(8, 2)
    curve = npg.Curve(dataclasses.replace(case(npg, "npg"), contestant="npg_gpu"))
    judge, judged = curve.judge, []
    curve.judge = lambda act: judged.append(act) or judge(act)
    curve.start(npg.mean_action(policy))
    expected = judge(npg.mean_action(policy))
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.3)
    curve.finish(100, npg.mean_action(policy))
    assert not judged  # while it learns
    first, last = curve.points()
    assert len(judged) == 2 and (first[0], last[0]) == (0, 100)
    assert first[2] == pytest.approx(expected, abs=1e-3) and first[2] != last[2]


def test_a_missing_peer_is_skipped_with_one_line(npg: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    import experiment

    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(experiment.Skipped, match="^sb3_contrib is not installed: pip install sb3-contrib$"):
        npg.measure(case(npg, "trpo_sb3"), npg.Options(short=True))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--contestants", "npg_gpu"], "npg_gpu needs a GPU: give --device cuda"),
        (["--tasks", "swimer"], "there is no task 'swimer': did you mean swimmer?"),
        (["--jobs", "1000"], "1000 jobs with 2 threads need as many cores"),
    ],
)
def test_bad_input_gets_one_line(
    npg: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    import experiment

    assert experiment.main(npg.EXPERIMENT, ["--short", "--out", str(tmp_path / "npg.jsonl"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_tables_and_figure_come_from_results_alone(npg: ModuleType, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    rows = []
    for name, slower in (("npg", 1.0), ("npg_gymnasium", 3.0), ("ppo_sb3", 20.0)):
        for seed in range(5):
            returns = np.linspace(0.0, 3000.0, 21) * random.uniform(0.9, 1.1, 21)
            curve = [
                [50_000 * i, 2.0 * slower * i, value, None if i == 0 else value - 100.0]
                for i, value in enumerate(returns)
            ]
            rows.append(row(npg, name, seed, curve, sampling_seconds=slower, mode="sync"))
    ends, agreement = npg.tables(rows)
    found = {line[1]: line for line in ends.rows}
    assert found["NPG, Gymnasium's environments (sync)"][8] == "3.00 (3.00 to 3.00)"
    assert len(agreement.rows) == 10 and "differ at none of them" in agreement.title
    npg.figure(rows).savefig(tmp_path / "npg.png")
    # a run that was stopped early is drawn, too
    npg.figure([rows[0], row(npg, "npg", 1, [[0, 0.0, 5.0, None], [50_000, 2.0, 9.0, None]])])


TOY = """
import dataclasses
import os


@dataclasses.dataclass(frozen=True)
class Case:
    number: int


def measure(case, options):
    if case.number == 2:
        raise RuntimeError("it broke")
    return {"cores": sorted(os.sched_getaffinity(0)), "process": os.getpid()}
"""


def test_cases_apart_are_processes_on_cores_of_their_own(
    npg: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import experiment

    (tmp_path / "apart_toy.py").write_text(TOY)
    monkeypatch.syspath_prepend(str(tmp_path))
    import apart_toy

    made = experiment.Experiment(
        "toy", "A toy.", lambda options: [apart_toy.Case(i) for i in range(3)], lambda case: 60.0, apart_toy.measure,
        lambda rows: [], None, apart=True,
    )  # fmt: skip
    out, before = tmp_path / "toy.jsonl", os.sched_getaffinity(0)
    jobs = min(2, len(before))
    assert experiment.main(made, ["--out", str(out), "--threads", "1", "--jobs", str(jobs)]) == 1
    assert "it broke" in capsys.readouterr().err and os.sched_getaffinity(0) == before
    results = [found.result for found in experiment.read(out)]
    assert len(results) == 2 and len({result["process"] for result in results} | {os.getpid()}) == 3
    assert all(len(result["cores"]) == 1 for result in results)
