from pathlib import Path

import experiment
import plot
import pytest
import throughput


def run(out: Path, words: str) -> list[experiment.Row]:
    assert experiment.main(throughput.EXPERIMENT, ["--short", "--out", str(out), *words.split()]) == 0
    return experiment.read(out)


def test_throughput_is_measured_once_and_written_as_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "throughput.jsonl"
    words = "--tasks hopper --contestants native c gymnasium gym-sync --threads 1 --parts sampling single kept"
    cases = {(row.case["part"], row.case["contestant"]): row for row in run(out, words)}
    sampling = {("sampling", name) for name in ("native", "c", "gym-sync")}
    assert cases.keys() == sampling | {("single", "gymnasium"), ("single", "c"), ("kept", "c")}
    rates = {name: row.result["env_steps_per_second"] for name, row in cases.items()}
    assert min(rates.values()) > 0.0 < cases["kept", "c"].result["kept"]
    assert {row.case["worlds"] for (part, _), row in cases.items() if part == "single"} == {1}
    native, ours = (rates["sampling", name] for name in ("native", "c"))
    assert f"| {ours:,.0f}; {ours / native:.2f} |" in capsys.readouterr().out
    assert len(run(out, words)) == len(cases) and "6 of 6 cases are stored" in capsys.readouterr().out
    assert plot.main(experiment.Stored(("throughput",), tmp_path)) == 0
    assert len([*tmp_path.glob("throughput-*.png")]) == 1


def test_every_library_is_measured_on_several_numbers_of_cores_and_worlds() -> None:
    words = {"tasks": ("cartpole",), "contestants": ("native", "c"), "threads": 2, "parts": ("cores", "worlds")}
    cases = throughput.cases(throughput.Options(short=True, **words))
    found = [(case.part, case.contestant, case.worlds, case.threads) for case in cases]
    cores = [("cores", name, 64 * threads, threads) for name in ("native", "c") for threads in (1, 2)]
    assert found == [*cores, *(("worlds", "c", many, 2) for many in (1, 8, 64))]


def test_dm_control_tasks_are_measured_with_equal_numbers_of_worlds_by_every_library() -> None:
    options = throughput.Options(parts=("suite",), tasks=("dm/cheetah_run", "dm/quadruped_walk"), threads=2, repeats=1)
    found = [(case.task, case.worlds, case.contestant) for case in throughput.cases(options)]
    assert found.count(("dm/cheetah_run", 16, "envpool")) == 1 and len(found) == 3 * (3 + 2)
    assert ("dm/quadruped_walk", 16, "envpool") not in found
    assert {case.threads for case in throughput.cases(options)} == {2}
