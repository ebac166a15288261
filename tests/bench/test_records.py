from pathlib import Path

import experiment
import pytest
import records


@pytest.mark.long
def test_resumed_run_adds_to_the_measured_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ("--algorithm", "npg", "--mean-every", "1", "--nworld", "2", "--samples", "100", "--mean-episodes", "2")
    monkeypatch.setitem(records.RECORDS, "point_mass", {"cpu": (-1e4, flags)})
    words = ["--tasks", "point_mass", "--seeds", "3", "--out", str(tmp_path / "records.jsonl"), "--runs", str(tmp_path)]
    assert experiment.main(records.EXPERIMENT, [*words, "--seconds", "0"]) == 0
    assert "point_mass-cpu-warm-3 has not reached -10000" in capsys.readouterr().out
    assert experiment.main(records.EXPERIMENT, words) == 0
    (row,) = experiment.read(tmp_path / "records.jsonl")
    assert row.result["samples"] == 100 and row.result["seconds"] > row.result["learning_seconds"] > 0.0
    assert "| point_mass | -10,000 | cpu | warm | 3 |" in capsys.readouterr().out
