from pathlib import Path

import experiment
import policies
import pytest


def test_a_pretrained_policy_is_compared_between_engines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "policies.jsonl"
    assert experiment.main(policies.EXPERIMENT, ["--short", "--out", str(out)]) == 0
    (row,) = experiment.read(out)
    engines, physics = row.result["comparisons"]
    assert engines["first"] == "C engine" and physics["second"] == "fast physics"
    assert "| cartpole_swingup | 4 | Warp engine on cpu | C engine | " in capsys.readouterr().out
