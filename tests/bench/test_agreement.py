import json
from pathlib import Path
from typing import Any

import agreement
import experiment
import pytest


def run(out: Path, *words: str) -> list[dict[str, Any]]:
    assert experiment.main(agreement.EXPERIMENT, ["--out", str(out), *words]) == 0
    return [json.loads(line)["result"] for line in out.read_text().splitlines()]


def test_a_task_is_compared_with_the_unmodified_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hopper, ant = run(tmp_path / "agreement.jsonl", "--tasks", "hopper", "ant", "--steps", "120")
    assert hopper["contact_force"] is None and hopper["obs"] < 1e-6 and hopper["reward"] < 1e-5
    assert hopper["agree_steps"] == 120 and hopper["terminations"] > 0 == hopper["different_terminations"]
    # Gymnasium computes the ant's contact forces after the last substep
    assert ant["obs"] < 1e-6 < 1e-3 < ant["contact_force"]
    assert "| hopper | NEWTON, NEWTON | 120 of 120 |" in capsys.readouterr().out
