"""What the experiments share."""

import copy
import dataclasses
import json
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture
def experiment(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCH))
    import experiment

    return experiment


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    repeat: int
    contestant: str


RATES = {"ours": 3.0, "theirs": 2.0}


@pytest.fixture
def toy(experiment: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Any:
    """An experiment whose measurements are known; ``toy.measured`` lists what was measured."""
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
        from lyceum_warp.viz.style import new_figure

        drawn = new_figure("a toy", 2, 2)
        drawn.subplots().plot([row.result["rate"] for row in rows])
        return drawn

    made = experiment.Experiment("toy", "A toy.", cases, lambda case: 60.0, measure, tables, figure)
    monkeypatch.setattr(experiment, "NAMES", ("toy",))
    monkeypatch.setitem(sys.modules, "toy", SimpleNamespace(EXPERIMENT=made))
    return SimpleNamespace(measured=measured, main=lambda *words: experiment.main(made, [*map(str, words)]))


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_results_carry_their_case_and_provenance(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert toy.main("--out", tmp_path / "new" / "toy.jsonl") == 0
    rows = lines(tmp_path / "new" / "toy.jsonl")
    assert rows[0]["case"] == {"task": "hop", "repeat": 0, "contestant": "ours"} and rows[0]["result"] == {"rate": 3.0}
    assert {"cpu", "cores", "mujoco", "python", "date"} <= rows[0]["provenance"].keys() and len(rows) == 8
    out = capsys.readouterr().out
    assert out.startswith("toy: 0 of 12 cases are there; the rest takes about 12 min\n")
    assert out.count("a_missing_peer is not installed: pip install a-missing-peer==1.0") == 1
    assert "| ours | 1.50 (1.50 to 1.50) |\n| theirs | 1.00 (1.00 to 1.00) |" in out


def test_stopped_run_continues_without_measuring_again(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "toy.jsonl"
    assert toy.main("--out", path, "--contestants", "ours", "--seeds", 13) == 130
    assert "stopped; the same command continues" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[:-9])  # the second line was torn off
    toy.measured.clear()
    assert toy.main("--out", path, "--contestants", "ours") == 0
    assert [(case.task, case.repeat) for case in toy.measured] == [("hop", 1), ("walk", 0), ("walk", 1)]
    captured = capsys.readouterr()
    assert "1 of 4 cases are there" in captured.out and "line 2 was torn off" in captured.err
    assert len(lines(path)) == 4
    toy.measured.clear()
    assert toy.main("--out", path, "--contestants", "ours") == 0 and not toy.measured


def test_results_of_other_machines_and_versions_do_not_count(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], experiment: ModuleType
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
        rows = experiment.read(path)
        assert [len(same) for same in experiment.by_machine(rows).values()] == [1] * len(
            {r.provenance["cores"] for r in rows}
        )
        row = lines(path)[-1]


def test_a_missing_peer_separates_no_results(toy: Any, tmp_path: Path, experiment: ModuleType) -> None:
    path, options = tmp_path / "toy.jsonl", ("--contestants", "ours", "--tasks", "hop", "--repeats", 1)
    toy.main("--out", path, *options)
    row = lines(path)[0]
    for installed, kept in (({}, 2), ({"other": "2"}, 2), ({"peer": "1", "other": "2"}, 2), ({"peer": "2"}, 1)):
        first, second = copy.deepcopy(row), copy.deepcopy(row)
        first["provenance"]["peers"], second["provenance"]["peers"] = {"peer": "1"}, installed
        second["case"]["repeat"] = 1
        path.write_text("".join(json.dumps(line) + "\n" for line in (first, second)))
        (same,) = experiment.by_machine(experiment.read(path)).values()
        assert len(same) == kept
    numbered = [copy.deepcopy(row) for _ in range(3)]
    for number, (line, installed) in enumerate(zip(numbered, ({"peer": "1"}, {"peer": "2"}, {}), strict=True)):
        line["provenance"]["peers"], line["case"]["repeat"] = installed, number
    path.write_text("".join(json.dumps(line) + "\n" for line in numbered))
    (same,) = experiment.by_machine(experiment.read(path)).values()
    assert [found.case["repeat"] for found in same] == [1, 2]


def test_failing_case_leaves_the_others(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "toy.jsonl"
    assert toy.main("--out", path, "--contestants", "ours", "--seeds", 14) == 1
    assert len(lines(path)) == 3 and "failed: task=walk repeat=0 contestant=ours" in capsys.readouterr().err


def test_dry_run_prints_cases_and_measures_nothing(
    toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert toy.main("--out", tmp_path / "toy.jsonl", "--tasks", "walk", "--dry-run") == 0
    assert "task=walk repeat=1 contestant=missing: 60 s" in capsys.readouterr().out
    assert not toy.measured and not (tmp_path / "toy.jsonl").exists()


def test_bad_input_gets_one_line(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert toy.main("--tasks", "hopp") == 2
    assert capsys.readouterr().err == "toy: there is no task 'hopp': did you mean hop?\n"
    (tmp_path / "toy.jsonl").write_text("{}\n")
    assert toy.main("--out", tmp_path / "toy.jsonl") == 2
    assert capsys.readouterr().err.endswith("toy.jsonl: line 1 is not a result of an experiment\n")


def test_figures_and_tables_come_from_results_alone(
    toy: Any, tmp_path: Path, experiment: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    import plot
    import tables

    toy.main("--out", tmp_path / "toy.jsonl")
    toy.measured.clear()
    assert plot.main(plot.Options(("toy",), tmp_path)) == 0
    drawn = {path.name: path.read_bytes() for path in tmp_path.glob("toy-*.*")}
    assert plot.main(plot.Options(("toy",), tmp_path)) == 0
    assert drawn == {path.name: path.read_bytes() for path in tmp_path.glob("toy-*.*")}
    assert sorted(path.suffix for path in tmp_path.glob("toy-*-cores.*")) == [".png", ".svg"]
    document = tmp_path / "README.md"
    document.write_text("# Before\n\n<!-- table toy -->\nold\n<!-- end -->\n\nAfter\n")
    for _ in range(2):  # the second run replaces the tables of the first
        assert tables.main(tables.Options(("toy",), tmp_path, document)) == 0
        text = document.read_text()
        assert text.startswith("# Before\n\n<!-- table toy -->\n") and text.endswith("\n<!-- end -->\n\nAfter\n")
        assert "old" not in text and text.count("| ours | 1.50 (1.50 to 1.50) |") == 1
    assert not toy.measured
    with pytest.raises(FileNotFoundError, match="run an experiment first"):
        plot.main(plot.Options((), tmp_path / "empty"))
    document.write_text("no place")
    with pytest.raises(ValueError, match="add <!-- table toy --> and <!-- end -->"):
        tables.main(tables.Options(("toy",), tmp_path, document))


def test_peer_has_an_environment_of_its_own(
    experiment: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import peers

    monkeypatch.setattr(peers, "FOLDER", tmp_path)
    monkeypatch.setenv("LYCEUM_WARP_PEERS", str(tmp_path / "cache"))
    (tmp_path / "echo").mkdir()
    (tmp_path / "echo" / "requirements.txt").write_text("")
    worker = "import json, sys\nprint('noise')\nprint(json.dumps({'prefix': sys.prefix} | json.load(sys.stdin)))\n"
    (tmp_path / "echo" / "worker.py").write_text(worker)
    answer = peers.peer("echo").run(samples=3)
    assert answer["samples"] == 3 and Path(answer["prefix"]).parent == tmp_path / "cache"
    began = time.perf_counter()
    peers.peer.cache_clear()
    peers._failure.cache_clear()
    assert peers.peer("echo") and time.perf_counter() - began < 1.0  # it is there
    (tmp_path / "echo" / "worker.py").write_text("raise ValueError('no')")
    with pytest.raises(RuntimeError, match="ValueError: no"):
        peers.peer("echo").run()
    (tmp_path / "echo" / "worker.py").write_text("import a_missing_package")
    with pytest.raises(experiment.Skipped, match="echo needs the package a_missing_package"):
        peers.peer("echo").run()
    (tmp_path / "lost").mkdir()
    (tmp_path / "lost" / "requirements.txt").write_text(f"{tmp_path}/no_package.whl\n")
    for _ in range(2):
        with pytest.raises(experiment.Skipped, match="lost cannot be installed: .*no_package"):
            peers.peer("lost")
    assert capsys.readouterr().out.count("making a virtual environment for lost") == 1
