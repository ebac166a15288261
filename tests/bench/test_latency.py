"""The experiment on the latency of controllers."""

import json
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

import lyceum_warp as lw

BENCH = Path(__file__).parents[2] / "bench"
SMALL = ("--short", "--seconds", "0.5", "--threads", "2")


@pytest.fixture(scope="module")
def latency() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCH))
        import latency

        yield latency


def run(latency: ModuleType, *words: Any) -> int:
    import experiment

    return int(experiment.main(latency.EXPERIMENT, [str(word) for word in words]))


@pytest.fixture(scope="module")
def results(latency: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("latency") / "latency.jsonl"
    assert run(latency, *SMALL, "--out", path) == 0
    return path


def options(latency: ModuleType, *words: str) -> Any:
    import tyro

    return tyro.cli(latency.Options, args=words)


def row(latency: ModuleType, task: str, contestant: str, samples: int, milliseconds: float, **more: Any) -> Any:
    import experiment

    case = latency.Case(task, contestant, "cpu", 2, samples, 8, 0.0, 1.0, 0, 0)
    result = {"period_ms": 20.0, "median_ms": milliseconds, "p99_ms": None, "max_ms": milliseconds, **more}
    return experiment.Row(experiment.dataclasses.asdict(case), result, {}, 1.0)


def test_short_mode_measures_planning_time_and_real_time(results: Path) -> None:
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    assert [(row["case"]["samples"], row["case"]["horizon"], row["case"]["slow"]) for row in rows] == [
        (16, 8, 0.0), (16, 32, 0.0), (16, 32, 2.5),
    ]  # fmt: skip
    for found in (row["result"] for row in rows):
        assert found["period_ms"] == pytest.approx(20.0)
        assert 0.0 < found["median_ms"] <= found["max_ms"] and found["plans"] >= 2
        assert found["steps"] >= 10 and 0.0 <= found["met"] <= 1.0 and 0.5 < found["age_mean"] <= found["age_max"]
    slowed = rows[2]["result"]
    assert slowed["median_ms"] >= 50.0 and slowed["met"] == 0.0 and slowed["age_max"] >= 3


def test_second_run_measures_nothing(
    latency: ModuleType, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = results.read_bytes()
    monkeypatch.setattr(latency.lw, "make", None)
    assert run(latency, *SMALL, "--out", results) == 0
    assert results.read_bytes() == before
    assert "latency: 3 of 3 cases are there" in capsys.readouterr().out


def test_tables_and_figure_need_results_alone(latency: ModuleType, results: Path) -> None:
    import experiment

    rows = experiment.read(results)
    (table,) = latency.tables(rows)
    assert [cells[:4] for cells in table.rows] == [
        ["reach", "C engine", "16", "8"], ["reach", "C engine", "16", "32"], ["reach", "C engine, × 2.5", "16", "32"],
    ]  # fmt: skip
    assert table.rows[2][8] == "0.0%"
    drawn = latency.figure(rows)
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert titles[0] == "reach, C engine" and len(drawn.axes[0].texts) == 2
    with pytest.raises(ValueError, match="no planning times"):
        latency.figure(rows[2:])


def test_map_shows_the_time_of_every_size(latency: ModuleType) -> None:
    rows = [row(latency, "reach", name, 16 * 4**i, 1.5 * 30**i, met=1.0 - i) for name in ("c", "warp") for i in (0, 1)]
    upper, lower = [axes for axes in latency.figure(rows).axes if axes.get_title(loc="left")]
    for axes, engine in ((upper, "C"), (lower, "Warp")):
        assert axes.get_title(loc="left") == f"reach, {engine} engine"
        assert [text.get_text() for text in axes.texts] == ["1.5", "45"]
        assert [text.get_fontweight() for text in axes.texts] == ["bold", "normal"]


def test_table_leaves_out_what_was_not_measured(latency: ModuleType) -> None:
    (table,) = latency.tables([row(latency, "reach", "c", 4096, 12000.0)])
    assert table.rows[0][4:] == ["12000", "", "12000", "20", "", "", "", ""]


def test_engines_take_turns_in_every_repeat(latency: ModuleType) -> None:
    words = ("--tasks", "reach", "humanoid", "--samples", "16", "--horizons", "8", "--repeats", "2", "--slow", "3")
    listed = latency.cases(options(latency, *words, "--contestants", "c", "warp"))
    assert [(case.repeat, case.task, case.contestant, case.slow) for case in listed] == [
        (repeat, *rest)
        for repeat in (0, 1)
        for rest in (("reach", "c", 0.0), ("reach", "warp", 0.0), ("humanoid", "c", 0.0), ("humanoid", "warp", 0.0),
                     ("reach", "c", 3.0))
    ]  # fmt: skip


def test_engine_of_one_thread_takes_part_on_a_gpu_alone(latency: ModuleType) -> None:
    assert {case.contestant for case in latency.cases(options(latency))} == {"c"}
    listed = latency.cases(options(latency, "--device", "cuda"))
    assert {(case.contestant, case.device) for case in listed} == {("c", "cpu"), ("warp", "cuda")}


def test_plan_that_takes_too_long_is_measured_once(latency: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow:
        actions = torch.zeros(8, 7)

        def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            time.sleep(0.02)
            return self.actions[0]

    monkeypatch.setattr(latency, "planner", lambda *_: Slow())
    monkeypatch.setattr(latency, "LONGEST", 0.01)
    given = options(latency, *SMALL)
    found = latency.measure(latency.cases(given)[0], given)
    assert found["plans"] == 1 and found["median_ms"] >= 20.0 and "met" not in found


def test_planner_that_does_not_fit_into_memory_is_skipped(latency: ModuleType) -> None:
    from experiment import Skipped

    case = latency.Case("point_mass", "c", "cpu", 1, 10**9, 4, 0.0, 0.3, 0, 0)
    with pytest.raises(Skipped, match="point_mass, 1000000000 samples of 4 steps: .* GB free"):
        latency.planner(case, 1, 0.02)


def test_planner_of_the_warp_engine_is_measured(latency: ModuleType) -> None:
    case = latency.Case("point_mass", "warp", "cpu", 1, 4, 4, 0.0, 0.3, 0, 0)
    found = latency.measure(case, options(latency, *SMALL))
    assert found["plans"] >= 10 and found["steps"] == 15 and found["real_time_threads"] == 1


def test_episodes_follow_each_other_until_the_time_is_over(latency: ModuleType) -> None:
    """Hopper falls after a few steps under an action that does nothing."""
    plant = lw.make("hopper", nthread=1, autoreset=False, horizon=0)

    class Still:
        actions, calls = torch.zeros(1, 3), 0

        def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
            self.calls += 1
            return self.actions[0]

    still = Still()
    case = latency.Case("hopper", "c", "cpu", 2, 1, 1, 0.0, 0.3, 0, 0)
    report = latency.waiting(plant, still, case, 0.001)
    assert report.episodes > 1 and report.steps == still.calls == 300


def test_task_without_its_model_is_skipped_with_one_line(
    latency: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(task: str, **words: Any) -> None:
        raise FileNotFoundError("the model comes with a package that is not installed: pip install it")

    monkeypatch.setattr(latency.lw, "make", make)
    assert run(latency, *SMALL, "--out", tmp_path / "latency.jsonl") == 0
    assert capsys.readouterr().out.count("skipped: reach: the model comes with") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--tasks", "raech"), "there is no task 'raech': did you mean reach?"),
        (("--contestants", "jax"), "there is no contestant 'jax'"),
        (("--samples", "0"), "--samples"),
        (("--seconds", "-1"), "--seconds"),
        (("--threads", "0"), "--threads"),
    ],
)
def test_bad_input_gets_one_line(
    latency: ModuleType, words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(latency, *words, "--dry-run") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("latency: ") and message in line
