"""Episodes in files, reports on them, and pictures of them."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_control import clocked, towards

import lyceum_warp as lw
from lyceum_warp.control.control_report import control_report, wilson
from lyceum_warp.control.loop import control
from lyceum_warp.control.trajectory import Trajectory
from lyceum_warp.viz.control_plot import control_plot


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


@pytest.fixture(scope="module")
def episode(env: lw.Env) -> Trajectory:
    return control(env, towards, seed=3)


def test_a_file_gives_back_everything(episode: Trajectory, tmp_path: Path) -> None:
    path = episode.save(tmp_path / "new" / "episode.npz")
    assert [file.name for file in path.parent.iterdir()] == ["episode.npz"]
    loaded = Trajectory.load(path)
    for field in dataclasses.fields(Trajectory):
        one, other = getattr(episode, field.name), getattr(loaded, field.name)
        if isinstance(one, torch.Tensor):
            assert one.dtype == other.dtype and torch.allclose(one, other, rtol=0, atol=0, equal_nan=True), field.name
        else:
            assert one == other, field.name
    assert loaded.params["success_distance"] == pytest.approx(0.05) and loaded.versions["torch"]
    with np.load(path, allow_pickle=False) as file:  # with numpy alone
        assert file["states"].shape == (41, len(episode.states[0]))
        assert json.loads(str(file["info"]))["task"] == "point_mass"


def test_a_file_that_is_broken_or_foreign(episode: Trajectory, tmp_path: Path) -> None:
    whole = episode.save(tmp_path / "whole.npz").read_bytes()
    broken = tmp_path / "broken.npz"
    middle = len(whole) // 2
    for content in (b"", b"no zip", whole[:middle], whole[:-1], whole[:middle] + b"????????" + whole[middle + 8 :]):
        broken.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.npz is broken, or is no trajectory"):
            Trajectory.load(broken)
    with np.load(tmp_path / "whole.npz") as file:
        arrays = dict(file)
    for change in (
        {"plan_failed": arrays["plan_failed"][1:]},
        {"rewards": arrays["rewards"][:-1]}, {"states": arrays["states"][:, 0]}, {"plan_of": arrays["plan_of"] + 1},
        {"info": np.array("{}")}, {"success": arrays["success"].astype(int)},
    ):  # fmt: skip
        np.savez(broken, **(arrays | change))
        with pytest.raises(ValueError, match=r"broken\.npz is broken, or is no trajectory"):
            Trajectory.load(broken)
    np.save(broken.with_suffix(".npy"), np.zeros(3))
    with pytest.raises(ValueError, match="is broken, or is no trajectory"):
        Trajectory.load(broken.with_suffix(".npy"))
    np.savez(broken, **(arrays | {"info": np.array(json.dumps({"format": 2}))}))
    with pytest.raises(ValueError, match=r"written by a newer lyceum_warp \(format 2"):
        Trajectory.load(broken)
    with pytest.raises(FileNotFoundError):
        Trajectory.load(tmp_path / "nowhere.npz")


# the report


def timed(episode: Trajectory, times: np.ndarray) -> Trajectory:
    """The episode as if its plans had taken these times, the first one a second."""
    plans = len(times) + 1
    return dataclasses.replace(
        episode, plan_times=torch.tensor([1.0, *times], dtype=torch.float64), plan_of=torch.zeros_like(episode.plan_of),
        plan_starts=torch.arange(plans, dtype=torch.float64), plan_steps=torch.zeros(plans, dtype=torch.int64),
    )  # fmt: skip


def test_quantiles(episode: Trajectory) -> None:
    times = np.random.default_rng(0).gamma(2, 0.005, 1000)
    report = control_report(timed(episode, times))
    for name, q in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("p99_9", 0.999), ("max", 1.0)):
        assert getattr(report, f"plan_{name}_ms") == pytest.approx(1000 * np.quantile(times, q))
    assert report.plan_jitter_ms == pytest.approx(1000 * times.std(ddof=1))
    assert report.misses == (times > episode.timestep).sum()
    assert control_report(timed(episode, times), rate=100).misses == (times > 0.01).sum()
    assert report.first_plan_ms == 1000
    for plans, missing in ((999, "p99_9"), (99, "p99"), (9, "p90"), (1, "p50"), (0, "max")):
        report = control_report(timed(episode, times[:plans]))
        assert getattr(report, f"plan_{missing}_ms") is None
    assert report.miss_share is None and ("planning time max", "-") in report.rows()


def test_many_episodes(episode: Trajectory) -> None:
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
    for wrong in (0.0, math.inf, "fast"):
        with pytest.raises(ValueError, match="rate has to be plans a second"):
            control_report(three, rate=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a trajectory at least"):
        control_report([])
    with pytest.raises(ValueError, match="differ in their mode"):
        control_report([episode, dataclasses.replace(episode, mode="async")])


def test_the_interval_of_a_share() -> None:
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0, 0.2775), abs=1e-4)
    assert wilson(10, 10) == pytest.approx((0.7225, 1), abs=1e-4)


def test_json_is_finite(episode: Trajectory, tmp_path: Path) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(text)

    rewards = torch.full_like(episode.rewards, math.inf)
    odd, even = (dataclasses.replace(e, params={"range": (0.7, math.inf)}) for e in (episode, episode))
    odd = dataclasses.replace(odd, rewards=rewards)
    path = control_report([odd, even]).write(tmp_path / "new" / "report.json")
    content = json.loads(path.read_text(), parse_constant=refuse)
    assert content["return_mean"] is None and content["params"] == {"range": [0.7, None]}
    assert content["steps"] == 80 and content["task"] == "point_mass" and content["plan_p99_9_ms"] is None
    assert [file.name for file in path.parent.iterdir()] == ["report.json"]


def test_rows_are_for_people(episode: Trajectory, env: lw.Env) -> None:
    rows = dict(control_report(episode).rows())
    assert rows["episodes"] == "1 of point_mass (40 steps, sync)"
    assert rows["planning time p99.9"] == "-" and rows["planning time p50"].endswith(" ms")
    assert "late ticks" not in rows
    rows = dict(control_report(clocked(env, seconds=2.5, steps=9)).rows())
    assert rows["late ticks"] == "0 of 9" and rows["missed deadlines (1000 ms)"].endswith("(100.0%)")
    assert rows["age of the action, max"] == "5 steps (5000 ms)"


# the picture


def test_a_picture(episode: Trajectory, env: lw.Env, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    single = control(env, towards, steps=1)
    for episodes in (episode, [episode, control(env, towards, seed=8)], clocked(env, seconds=2.5, steps=9), single):
        path = control_plot(episodes, tmp_path / "new" / "control.png", title="a title")
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000
    with pytest.raises(ValueError, match="a trajectory at least"):
        control_plot([], tmp_path / "none.png")


def test_a_picture_without_matplotlib(episode: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"needs matplotlib: pip install 'lyceum-warp\[viz\]'"):
        control_plot(episode, tmp_path / "none.png")
