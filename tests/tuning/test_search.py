import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from training_runs import CONFIG

import lyceum_warp as lw
from lyceum_warp.tuning import search
from lyceum_warp.tuning.trial import SHORT, Trials

QUICK = {"short": True, "episodes": 8, "nworld": 8, "nthread": 1}


@pytest.fixture
def no_measuring(monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(own: Trials, setting: Any) -> Any:
        raise AssertionError(f"{setting.name} was measured")

    monkeypatch.setattr(Trials, "measure", measure)


@pytest.fixture(scope="module", autouse=True)
def brief() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(search, "SHORT", dataclasses.replace(SHORT, repeats=2, block_seconds=0.005, steps=40))
        yield


@pytest.fixture(scope="module")
def tuned(brief: None, tmp_path_factory: pytest.TempPathFactory) -> lw.Tuning:
    return lw.tune("half_cheetah", out=tmp_path_factory.mktemp("tune") / "rows.jsonl", tolerance="loose", **QUICK)


def test_best_setting_is_the_fastest_row_with_unchanged_returns(tuned: lw.Tuning) -> None:
    speeds = [row["speedup"] for row in tuned.rows]
    assert speeds == sorted(speeds, reverse=True)
    same = [row for row in tuned.rows if row["verdict"] == "same"]
    assert tuned.best == (same[0] if same else None)
    if tuned.best is not None:
        assert lw.PhysicsOptions(**tuned.best["physics"]).given() and tuned.flags and "fast" in tuned.task_line


def test_a_stopped_search_resumes_from_its_file(tuned: lw.Tuning, no_measuring: None) -> None:
    again = lw.tune("half_cheetah", out=tuned.path, tolerance="loose", **QUICK)
    assert again == tuned
    rows = lw.tune("half_cheetah", out=tuned.path, tolerance="strict", **QUICK).rows
    assert len(rows) <= len(tuned.rows)


@pytest.mark.parametrize("change", [{"nworld": 4}, {"seed": 1}, {"ctrl_cost_weight": 0.2}, {"integrator": "rk4"}])
def test_stored_results_are_not_reused_for_other_options(
    change: dict[str, Any], tuned: lw.Tuning, no_measuring: None
) -> None:
    with pytest.raises(AssertionError, match="was measured"):
        lw.tune("half_cheetah", out=tuned.path, **{**QUICK, **change})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "point_mass"
    env = lw.make("point_mass", nworld=2, nthread=1, success_distance=0.05)
    lw.train(lw.NPG(env, config=CONFIG), folder, 1)
    return folder


def test_tune_evaluates_the_policy_of_a_run_with_the_parameters_of_the_run(run: Path, tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = []

    def stop(row: dict[str, Any]) -> None:
        rows.append(row)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lw.tune("point_mass", run=run, out=tmp_path / "rows.jsonl", progress=stop, **QUICK)
    assert set(rows[0]["returns"]) == {"random", "policy"}


def test_each_invalid_argument_of_tune_raises_an_error(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("bread\nmilk\n")
    wrong: list[tuple[str, dict[str, Any], str]] = [
        ("hoper", {}, "there is no task 'hoper': did you mean hopper"),
        ("hopper", {"tolerance": "tight"}, "tolerance must be 'strict', 'loose' or 'any', not 'tight'"),
        ("hopper", {"run": run}, "is a run of the task 'point_mass', not of the task 'hopper'"),
        ("hopper", {"run": tmp_path / "none"}, "there is no run in"),
        ("point_mass", {"run": run, "which": "worst"}, "no policy is named 'worst': pass 'last'"),
        ("hopper", {"episodes": 0}, "episodes must be a whole number from 1 .*, not 0"),
        ("hopper", {"out": other, "nworld": 2}, "line 1 of .*notes.txt is not a result of tune: use another file"),
        ("hopper", {"gravity": 3}, "gravity"),
    ]
    for task, words, message in wrong:
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            lw.tune(task, **words)
    assert other.read_text() == "bread\nmilk\n"
