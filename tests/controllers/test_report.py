import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_controllers import SamplingPlanner, towards

import lyceum_warp as lw
from lyceum_warp.controllers import Trajectory, control, control_report


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


@pytest.fixture(scope="module")
def episode(env: lw.Env) -> Trajectory:
    return control(env, towards, seed=3)


def with_plan_times(episode: Trajectory, times: np.ndarray) -> Trajectory:
    """Replace the planning times. The first plan takes one second."""
    plans = len(times) + 1
    return dataclasses.replace(
        episode, plan_times=torch.tensor([1.0, *times], dtype=torch.float64), plan_of=torch.zeros_like(episode.plan_of),
        plan_starts=torch.arange(plans, dtype=torch.float64), plan_steps=torch.zeros(plans, dtype=torch.int64),
    )  # fmt: skip


@pytest.fixture(scope="module")
def times() -> np.ndarray:
    return np.random.default_rng(0).gamma(2, 0.005, 1000)


def test_planning_time_summary_excludes_the_first_plan(episode: Trajectory, times: np.ndarray) -> None:
    timed = with_plan_times(episode, times)
    report = control_report(timed)
    for name, q in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("p99_9", 0.999), ("max", 1.0)):
        assert getattr(report, f"plan_{name}_ms") == pytest.approx(1000 * np.quantile(times, q))
    assert report.plan_jitter_ms == pytest.approx(1000 * times.std(ddof=1))
    assert report.first_plan_ms == 1000 and report.misses == (times > episode.timestep).sum()
    assert control_report(timed, rate=100).misses == (times > 0.01).sum()


def test_report_omits_a_quantile_with_too_few_plans(episode: Trajectory, times: np.ndarray) -> None:
    for plans, missing in ((999, "p99_9"), (99, "p99"), (9, "p90"), (1, "p50"), (0, "max")):
        report = control_report(with_plan_times(episode, times[:plans]))
        assert getattr(report, f"plan_{missing}_ms") is None
    assert report.miss_share is None and ("planning time max", "-") in report.rows()


def test_success_rate_has_a_wilson_confidence_interval(episode: Trajectory) -> None:
    for successes, low, high in ((8, 0.4902, 0.9433), (0, 0, 0.2775), (10, 0.7225, 1)):
        ten = [
            dataclasses.replace(episode, success=torch.ones(40, dtype=torch.bool) & (i < successes)) for i in range(10)
        ]
        report = control_report(ten)
        assert (report.success_low, report.success_high) == pytest.approx((low, high), abs=1e-4)


def test_several_episodes_give_one_report(episode: Trajectory) -> None:
    met = torch.ones_like(episode.success)
    three = [
        dataclasses.replace(episode, success=met & (i < 3), rewards=met * float(i), wall_seconds=float(i))
        for i in (1, 2, 3)
    ]
    report = control_report(three)
    assert (report.episodes, report.steps, report.plans) == (3, 120, 117)
    assert report.return_mean == 80 and report.return_std == pytest.approx(40)
    assert report.success == pytest.approx(2 / 3)
    assert report.episode_seconds_mean == 2 and report.real_time_factor == pytest.approx(120 * episode.timestep / 6)
    assert report.eval_mean == pytest.approx(float(episode.evals[-1]))
    assert report.tick_jitter_ms is None and report.late_ticks is None
    assert control_report(episode).return_std is None


def test_report_of_unsuitable_episodes_raises_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match="at least one trajectory"):
        control_report([])
    one = control(env, SamplingPlanner(0), steps=2)
    with pytest.raises(ValueError, match="rate must be a positive number of plans per second, not 0.0"):
        control_report(one, rate=0.0)
    with pytest.raises(ValueError, match="differ in their mode"):
        control_report([one, dataclasses.replace(one, mode="async")])
    controller = {**one.controller, "samples": 9}
    with pytest.raises(ValueError, match=r"differ in their controller \(samples\)"):
        control_report([one, dataclasses.replace(one, controller=controller)])
    odd = dataclasses.replace(one, params={**one.params, "odd": math.nan})
    assert control_report([odd, dataclasses.replace(odd, params={**one.params, "odd": float("nan")})]).episodes == 2


def test_failed_samples_are_reported(env: lw.Env) -> None:
    episode = control(env, SamplingPlanner(0, 8, 8, 2), steps=4, seed=1)
    assert episode.plan_failed.tolist() == [0, 8, 8, 2] and episode.plan_effective.tolist() == [2, 0, 0, 2]
    report = control_report(episode)
    assert (report.blind_plans, report.known_plans, report.failed_share) == (2, 4, 18 / 32)
    assert report.effective_samples_mean == 1.0
    rows = dict(report.rows())
    assert rows["plans without a good sample"] == "2 of 4" and rows["failed samples"] == "56.2 %"
    assert rows["effective samples, mean"] == "1"


def test_report_of_a_controller_without_samples_has_no_sample_statistics(env: lw.Env) -> None:
    episode = control(env, lambda state, obs: torch.zeros(2), steps=3)
    assert episode.plan_failed.isnan().all() and episode.plan_effective.isnan().all()
    report = control_report(episode)
    assert report.blind_plans is None and report.failed_share is None and report.effective_samples_mean is None
    assert not any("sample" in label for label, _ in report.rows())


def test_json_has_null_for_infinite_numbers(episode: Trajectory, tmp_path: Path) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(text)

    rewards = torch.full_like(episode.rewards, math.inf)
    odd, even = (dataclasses.replace(e, params={"range": (0.7, math.inf)}) for e in (episode, episode))
    odd = dataclasses.replace(odd, rewards=rewards)
    path = control_report([odd, even]).write(tmp_path / "new" / "report.json")
    content = json.loads(path.read_text(), parse_constant=refuse)
    assert content["return_mean"] is content["return_std"] is None and content["params"] == {"range": [0.7, None]}
    assert content["steps"] == 80 and content["task"] == "point_mass" and content["plan_p99_9_ms"] is None
    assert [file.name for file in path.parent.iterdir()] == ["report.json"]
