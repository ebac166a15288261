from pathlib import Path

import experiment
import humanoid
import pytest


def test_short_humanoid_run_uses_every_control_loop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--short", "--threads", "1", "--out", str(tmp_path / "humanoid.jsonl")]
    assert experiment.main(humanoid.EXPERIMENT, words) == 0
    out = capsys.readouterr().out
    assert "| humanoid_stand | in real time | 1 | horizon 40," in out and "physics fast | 1 of 1 " in out
    for row in experiment.read(tmp_path / "humanoid.jsonl"):
        assert row.result["seconds"] == pytest.approx(0.3) and not row.result["fell"] and row.result["up_share"] == 1.0
        assert "physics fast" in row.case["settings"]


def test_each_humanoid_task_has_its_own_success_criterion() -> None:
    def row(task: str, **result: object) -> experiment.Row:
        usual = {"fell": False, "speed": 0.7, "up_at_the_end": True, "seconds": 20.0, "plans": 100, "misses": 1,
                 "plan_ms": 8.0, "plan_max_ms": 16.0, "oldest_action_steps": 2}  # fmt: skip
        return experiment.Row(
            {"task": task, "contestant": "real_time", "settings": "knots 8", "threads": 2}, usual | result, {}, 1.0
        )

    rows = [
        row("humanoid_stand", speed=0.0), row("humanoid_stand", fell=True), row("humanoid_walk", speed=0.4),
        row("humanoid_walk", fell=True), row("humanoid_walk"), row("humanoid_get_up", up_at_the_end=False),
    ]  # fmt: skip
    (table,) = humanoid.tables(rows)
    assert [line[4].partition(" (")[0] for line in table.rows] == ["1 of 2", "1 of 3", "0 of 1"]
    assert {line[7] for line in table.rows} == {"99.00%"}
