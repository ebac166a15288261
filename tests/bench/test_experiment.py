import dataclasses
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import experiment
import plot
import pytest
import tables
import venvs


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

    def figure(rows: list[Any]) -> Any:
        from lyceum_warp.viz import new_figure

        plot = new_figure("a toy", 2, 2)
        plot.subplots().plot([row.result["rate"] for row in rows])
        return plot

    definition = experiment.Experiment("toy", "A toy.", cases, lambda case: 60.0, measure, tables, "C engine", figure)
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


def test_figures_and_tables_are_made_from_stored_results(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy.main("--out", tmp_path / "toy.jsonl")
    toy.measured.clear()
    assert plot.main(experiment.Stored(("toy",), tmp_path)) == 0
    pictures = {path.name: path.read_bytes() for path in tmp_path.glob("toy-*.png")}
    assert len(pictures) == 1
    for _ in range(2):
        assert plot.main(experiment.Stored(("toy",), tmp_path)) == tables.main(experiment.Stored((), tmp_path)) == 0
        text = (tmp_path / "toy.md").read_text()
        assert text.startswith("# toy\n") and text.count("| ours | 1.50 (1.50 to 1.50) |") == 1
    assert pictures == {path.name: path.read_bytes() for path in tmp_path.glob("toy-*.png")}
    assert not toy.measured
    with pytest.raises(FileNotFoundError, match="run an experiment first"):
        plot.main(experiment.Stored((), tmp_path / "empty"))


@pytest.mark.long
def test_other_library_runs_in_a_separate_virtual_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(venvs, "FOLDER", tmp_path)
    monkeypatch.setenv("LYCEUM_WARP_PEERS", str(tmp_path / "cache"))
    (tmp_path / "echo").mkdir()
    (tmp_path / "echo" / "requirements.txt").write_text("")
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import json, sys\nprint('noise')\nprint(json.dumps({'prefix': sys.prefix} | json.load(sys.stdin)))\n"
    )
    python = venvs.python_of("echo")
    answer = venvs.run(python, worker, samples=3)
    assert answer["samples"] == 3 and Path(answer["prefix"]).parent == tmp_path / "cache"
    venvs._made.cache_clear()
    assert venvs.python_of("echo") == python
    assert capsys.readouterr().out.count("making a virtual environment for echo") == 1
    worker.write_text("import a_missing_package")
    with pytest.raises(experiment.Skipped, match="a_missing_package"):
        venvs.run(python, worker)
    (tmp_path / "lost").mkdir()
    (tmp_path / "lost" / "requirements.txt").write_text(f"{tmp_path}/no_package.whl\n")
    with pytest.raises(experiment.Skipped, match="lost.*no_package"):
        venvs.python_of("lost")


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


@pytest.mark.long
def test_cases_run_in_subprocesses_on_separate_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "parallel_toy.py").write_text(TOY)
    monkeypatch.syspath_prepend(str(tmp_path))
    import parallel_toy

    definition = experiment.Experiment(
        "toy",
        "A toy.",
        cases=lambda options: [parallel_toy.Case(i) for i in range(3)],
        estimate=lambda case: 60.0,
        measure=parallel_toy.measure,
        tables=lambda rows: [],
        conditions="C engine",
        parallel=True,
    )
    out, before = tmp_path / "toy.jsonl", os.sched_getaffinity(0)
    assert experiment.main(definition, ["--out", str(out), "--threads", "1", "--jobs", "2"]) == 1
    assert "RuntimeError: it broke" in capsys.readouterr().err and os.sched_getaffinity(0) == before
    results = [row.result for row in experiment.read(out)]
    assert len(results) == 2 and len({result["process"] for result in results} | {os.getpid()}) == 3
    assert all(len(result["cores"]) == 1 for result in results)
