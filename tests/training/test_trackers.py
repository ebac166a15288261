import dataclasses
import importlib.util
import math
import resource
import signal
from pathlib import Path

import pytest

import lyceum_warp as lw
from lyceum_warp.training import TensorBoard
from lyceum_warp.training.trackers import tag


@pytest.fixture(scope="module")
def first() -> lw.Iteration:
    config = lw.NPGConfig(samples=96, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2)
    return next(lw.NPG(lw.make("point_mass", nworld=4, horizon=12), config=config))


def numbered(first: lw.Iteration, i: int, **changes: object) -> lw.Iteration:
    return dataclasses.replace(first, iteration=i, samples=96 * i, kl=0.01 * i, **changes)


def read(folder: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()


def curve(folder: Path, name: str) -> list[tuple[int, float]]:
    return [(point.step, pytest.approx(point.value)) for point in read(folder).Scalars(name)]


def test_every_number_of_an_iteration_is_written_as_a_curve_in_its_group(first: lw.Iteration, tmp_path: Path) -> None:
    iteration = numbered(first, 1, metrics={"forward": 2.5}, step_metrics={"forward": 0.5})
    with TensorBoard(tmp_path / "new" / "run") as board:
        board(iteration)
    scalars = read(tmp_path / "new" / "run").Tags()["scalars"]
    assert set(scalars) == {tag(name) for name in (*iteration.row(), "total_fps")}
    assert len(scalars) == len(iteration.row()) + 1
    seconds = iteration.time_sample + iteration.time_gradient + iteration.time_solve + iteration.time_value
    for name, value in [("Train/mean_reward", iteration.return_mean), ("mean_policy/return", iteration.mean_return),
                        ("policy/kl", 0.01), ("value/explained_variance", iteration.explained_variance),
                        ("Train/mean_episode_length", 12.0), ("metrics/forward", 2.5),
                        ("Episode_Metrics/forward", 0.5), ("Policy/mean_std", iteration.std_mean),
                        ("Perf/collection_time", iteration.time_sample), ("Perf/total_fps", 96 / seconds),
                        ("episode/faults", 0.0)]:  # fmt: skip
        assert curve(tmp_path / "new" / "run", name) == [(0, value)]
    assert {name.partition("/")[0] for name in scalars} == {
        "Train", "Policy", "Perf", "Episode_Metrics", "return", "episode", "mean_policy", "policy", "value", "time",
        "metrics",
    }  # fmt: skip


def test_terms_of_a_walking_robot_have_the_names_and_units_of_mjlab(first: lw.Iteration, tmp_path: Path) -> None:
    env = lw.make("go1_velocity", nworld=3, horizon=100)
    metrics = {"upright": 1.5, "fell_over": 0.25}
    with TensorBoard(tmp_path, env) as board:
        board(numbered(first, 1, metrics=metrics, step_metrics={"fell_over": 0.01, "velocity_error": 0.2}))
    seconds = 100 * env.timestep
    for name, value in [("Episode_Reward/upright", 1.5 / seconds), ("Episode_Termination/fell_over", 3 * 0.01),
                        ("Episode_Metrics/velocity_error", 0.2), ("metrics/fell_over", 0.25)]:  # fmt: skip
        assert curve(tmp_path, name) == [(0, value)]


def test_missing_and_non_finite_numbers_are_omitted(first: lw.Iteration, tmp_path: Path) -> None:
    with TensorBoard(tmp_path) as board:
        board(numbered(first, 1, return_mean=math.nan, mean_return=None))
        board(numbered(first, 2, return_mean=-3.0))
        # the points are written before the file is closed
        assert curve(tmp_path, "Train/mean_reward") == [(1, -3.0)]
        assert curve(tmp_path, "mean_policy/return") == [(1, first.mean_return)]


def test_resumed_run_replaces_points_after_its_checkpoint(first: lw.Iteration, tmp_path: Path) -> None:
    with TensorBoard(tmp_path) as board:
        for i in (1, 2, 3, 4):
            board(numbered(first, i))
    with TensorBoard(tmp_path) as board:
        for i in (3, 4, 5):
            board(numbered(first, i, return_mean=100.0))
    assert curve(tmp_path, "policy/kl") == [(i - 1, 0.01 * i) for i in (1, 2, 3, 4, 5)]
    assert [value for _, value in curve(tmp_path, "Train/mean_reward")] == [first.return_mean] * 2 + [100.0] * 3


def test_full_disk_raises_an_error(first: lw.Iteration, tmp_path: Path) -> None:
    before, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    board = TensorBoard(tmp_path)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
        with pytest.raises(OSError, match="File too large"):
            for i in range(1, 100):
                board(numbered(first, i))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    board.close()
    assert [step for step, _ in curve(tmp_path, "policy/kl")] == list(range(i))


def test_error_of_a_missing_package_names_the_install_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"TensorBoard needs tensorboard: pip install 'lyceum-warp\[tensorboard\]'$"):
        TensorBoard(tmp_path / "run")
    assert not (tmp_path / "run").exists()
