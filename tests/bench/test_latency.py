from pathlib import Path

import experiment
import latency
import pytest


def main(out: Path, *words: str) -> int:
    return experiment.main(latency.EXPERIMENT, ["--short", "--threads", "1", "--out", str(out), *words])


@pytest.mark.long
def test_short_latency_run_measures_plans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "latency.jsonl"
    assert main(out, "--samples", "8", "16") == 0
    assert "| own | 8 x 16 | C engine, cpu |" in capsys.readouterr().out
    for row in experiment.read(out):
        found = row.result
        assert found["plans"] > 1 and 0.0 < found["plan_ms"] <= found["max_ms"] and found["deadline_ms"] == 20.0
        assert found["age_steps"] <= found["age_steps_max"] and found["episodes"] == 1


def test_task_with_suggested_physics_is_also_planned_with_exact_physics() -> None:
    cases = latency.cases(latency.Options(tasks=("humanoid", "cartpole"), threads=2))
    assert {(case.task, case.physics) for case in cases} == {
        ("humanoid", "fast"), ("humanoid", "exact"), ("cartpole", "own"),
    }  # fmt: skip
    most = {physics: max(case.samples for case in cases if case.physics == physics) for physics in ("fast", "exact")}
    assert most == {"fast": 1024, "exact": 64}
    named = latency.cases(latency.Options(tasks=("humanoid", "cartpole"), physics=("fast",), samples=(4096,)))
    assert {(case.task, case.samples) for case in named} == {("humanoid", 4096)}


def test_own_flag_uses_the_suggested_samples_and_horizon() -> None:
    (case,) = latency.cases(latency.Options(tasks=("reach",), own=True))
    assert (case.samples, case.horizon) == (30, 16)
    with pytest.raises(ValueError, match="omit --samples and --horizons"):
        latency.cases(latency.Options(tasks=("reach",), own=True, samples=(8,)))
