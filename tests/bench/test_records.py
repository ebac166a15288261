import re
from pathlib import Path
from typing import Any

import experiment
import pytest
import records


def measure(folder: Path, monkeypatch: pytest.MonkeyPatch, target: float, *words: str) -> list[dict[str, Any]]:
    flags = ("--algorithm", "npg", "--mean-every", "1", "--nworld", "2", "--samples", "100", "--mean-episodes", "2")
    monkeypatch.setitem(records.RECORDS, "point_mass", {"cpu": (target, flags)})
    out = folder / "records.jsonl"
    usual = ["--tasks", "point_mass", "--seeds", "3", "--out", str(out), "--runs", str(folder)]
    assert experiment.main(records.EXPERIMENT, [*usual, *words]) == 0
    return [row.result for row in experiment.read(out)] if out.exists() else []


@pytest.mark.long
def test_resumed_run_adds_to_the_measured_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert measure(tmp_path, monkeypatch, -1e4, "--seconds", "0") == []
    (result,) = measure(tmp_path, monkeypatch, -1e4)
    assert result["reached"] and result["samples"] == 100
    assert result["seconds"] > result["learning_seconds"] > 0.0


@pytest.mark.long
def test_run_that_misses_its_target_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (result,) = measure(tmp_path, monkeypatch, 1e9, "--limit", "25")
    assert not result["reached"] and result["seconds"] >= 25.0


def test_medians_count_missed_targets_as_slower_than_all_others() -> None:
    def text(*runs: float) -> str:
        """Describe runs by seconds; a negative number is a limit at which a run was stopped, 0 an unknown limit."""
        results = [{"reached": run > 0.0, "seconds": abs(run) or None} for run in runs]
        return records.censored(results, "seconds", ".0f")

    assert text(30.0, 40.0, -20.0) == "40 (30 to > 20)"
    assert text(30.0, -263.0, 40.0, -20.0) == "> 30 (30 to > 263)"
    assert text(30.0, -263.0) == "> 146 (30 to > 263)"
    assert text(-263.0) == "> 263" and text(50.0) == "50"
    assert text(30.0, 0.0) == "not reached (30 to not reached)" and text(30.0, 40.0, 0.0) == "40 (30 to not reached)"
    assert records.censored([{"seconds": 5.0}], "seconds", ".1f") == "5.0"


def test_stored_training_times_are_medians_of_the_records() -> None:
    rows = experiment.read(experiment.RESULTS / "records.jsonl")
    page = (experiment.RESULTS / "training_times.md").read_text()
    table = re.findall(r"^\| `(\w+)` \|(( [-\d,.]+ \|){5})$", page, re.MULTILINE)
    assert len(table) == 16
    for task, cells, _ in table:
        target, warm, cold, cores_target, cores = (float(cell.replace(",", "")) for cell in cells.split("|")[:5])
        for device, cache, level, seconds in (
            ("cuda", "warm", target, warm), ("cuda", "cold", target, cold), ("cpu", "warm", cores_target, cores),
        ):  # fmt: skip
            machine, discount = ("Intel", "--gamma 0.995") if device == "cpu" else ("H200", "none")
            results = [
                row.result for row in rows
                if (row.case["task"], row.case["device"], row.case["cache"]) == (task, device, cache)
                and row.case["target"] == level and machine in f"{row.provenance['cpu']} {row.provenance.get('gpu')}"
                and discount not in row.case["flags"]
            ]  # fmt: skip
            median = records.censored(results, "seconds", ".1f").split(" (")[0]
            assert abs(float(median) - seconds) <= 0.55, (task, device, cache, median)
