import dataclasses
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import experiment
import pytest


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    repeat: int
    contestant: str


RATES = {"ours": 3.0, "theirs": 2.0}


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Any:
    """An experiment with predefined results. ``toy.measured`` lists the cases that ran."""
    measured: list[Case] = []

    def cases(options: Any) -> list[Case]:
        tasks = experiment.choose(options.tasks, ("hop", "walk"), what="task")
        contestants = experiment.choose(options.contestants, ("ours", "theirs", "missing"), what="contestant")
        return [Case(t, r, c) for t in tasks for r in range(options.repeats or 2) for c in contestants]

    def measure(case: Case, options: Any) -> dict[str, Any]:
        if case.contestant == "missing":
            experiment.installed("a_missing_peer", "a-missing-peer==1.0")
        measured.append(case)
        if options.seeds == (13,) and len(measured) == 3:
            raise KeyboardInterrupt
        if options.seeds == (14,) and len(measured) == 3:
            raise RuntimeError("it broke")
        return {"rate": RATES[case.contestant] * (case.repeat + 1)}

    def tables(rows: list[Any]) -> list[Any]:
        ratios = experiment.paired([row for row in rows if row.case["task"] == "hop"], "rate", "theirs")
        cells = [[name, experiment.median_and_range(values)] for name, values in ratios.items()]
        return [experiment.Table("Hopping", ["", "ratio"], cells)]

    definition = experiment.Experiment("toy", "A toy.", cases, lambda case: 60.0, measure, tables, "C engine")
    monkeypatch.setattr(experiment, "NAMES", ("toy",))
    monkeypatch.setitem(sys.modules, "toy", SimpleNamespace(EXPERIMENT=definition))
    return SimpleNamespace(measured=measured, main=lambda *words: experiment.main(definition, [*map(str, words)]))


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_stored_results_contain_their_case_machine_and_versions(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert toy.main("--out", tmp_path / "new" / "toy.jsonl") == 0
    rows = lines(tmp_path / "new" / "toy.jsonl")
    assert rows[0]["case"] == {"task": "hop", "repeat": 0, "contestant": "ours"} and rows[0]["result"] == {"rate": 3.0}
    assert {"cpu", "cores", "mujoco", "python", "date"} <= rows[0]["provenance"].keys() and len(rows) == 8
    out = capsys.readouterr().out
    assert out.startswith("toy: 0 of 12 cases are stored; the rest takes about 12 min\n")
    assert out.count("a_missing_peer is not installed: pip install a-missing-peer==1.0") == 1
    assert "| ours | 1.50 (1.50 to 1.50) |\n| theirs | 1.00 (1.00 to 1.00) |" in out


def test_stopped_experiment_continues_without_repeating_cases(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "toy.jsonl"
    assert toy.main("--out", path, "--contestants", "ours", "--seeds", 13) == 130
    assert "stopped; repeat the command to continue" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[:-9])
    toy.measured.clear()
    assert toy.main("--out", path, "--contestants", "ours") == 0
    assert [(case.task, case.repeat) for case in toy.measured] == [("hop", 1), ("walk", 0), ("walk", 1)]
    captured = capsys.readouterr()
    assert "1 of 4 cases are stored" in captured.out and "line 2 is incomplete" in captured.err
    assert len(lines(path)) == 4
    toy.measured.clear()
    assert toy.main("--out", path, "--contestants", "ours") == 0 and not toy.measured


def test_results_of_other_machines_and_versions_are_not_reused(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, options = tmp_path / "toy.jsonl", ("--contestants", "ours", "--tasks", "hop", "--repeats", 1)
    toy.main("--out", path, *options)
    row = lines(path)[0]
    for name, value in (("cores", 640), ("mujoco", "0.1")):
        row["provenance"][name] = value
        path.write_text(json.dumps(row) + "\n")
        toy.measured.clear()
        toy.main("--out", path, *options)
        assert len(toy.measured) == 1
        assert [len(same) for same in experiment.by_machine(experiment.read(path)).values()] == [1, 1]
        row = lines(path)[-1]


def test_results_count_the_cores_that_the_process_may_use(toy: Any, tmp_path: Path) -> None:
    with experiment.cores(1):
        toy.main("--out", tmp_path / "toy.jsonl", "--contestants", "ours")
    assert lines(tmp_path / "toy.jsonl")[0]["provenance"]["cores"] == 1


def test_failing_case_does_not_stop_other_cases(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "toy.jsonl"
    assert toy.main("--out", path, "--contestants", "ours", "--seeds", 14) == 1
    assert len(lines(path)) == 3 and "failed: task=walk repeat=0 contestant=ours" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words", "value"),
    [
        ("throughput", "--tasks hoper", "'hoper': did you mean hopper?"),
        ("throughput", "--device cuda:99", "cuda:99"),
        ("throughput", "--jobs 2", "throughput compete for the cores"),
        ("mppi", "--block 0", "block"),
        ("fidelity", "--jobs 1000", "1000 jobs"),
    ],
)
def test_invalid_options_are_named_in_one_line(
    name: str, words: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--short", "--out", str(tmp_path / "out.jsonl"), *words.split()]
    assert experiment.main(experiment.load(name), options) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"{name}: ") and value in error and error.count("\n") == 1
