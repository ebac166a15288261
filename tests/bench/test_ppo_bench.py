"""The program that measures seconds to mean rewards by rsl_rl's PPO."""

import csv
import json
import runpy
import sys
from pathlib import Path

import pytest

import lyceum_warp as lw

BENCH = Path(__file__).parents[2] / "bench"
METERED = Path(__file__).parents[1] / "metered_task.py"


def test_seconds_to_mean_rewards_are_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ppo.csv"
    options = ["--nworld", "8", "--iterations", "3", "--seeds", "4", "5", "--targets", "-1e6", "1e6"]
    config = ["--config.hidden", "8", "--config.value-hidden", "8", "--config.num-steps-per-env", "40"]
    files = ["--out", str(out), "--keep", str(tmp_path / "kept")]
    monkeypatch.setattr(sys, "argv", ["ppo.py", str(METERED), *options, *config, *files])
    monkeypatch.syspath_prepend(str(BENCH))
    runpy.run_path(str(BENCH / "ppo.py"), run_name="__main__")
    assert "seed 5, s" in capsys.readouterr().out
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["4"] * 3 + ["5"] * 3 and "metrics/effort" in rows[0]
    content = json.loads(out.with_suffix(".json").read_text())
    for result in content["rows"]:
        first, last = result["reached"]["-1e+06"], result["reached"]["1e+06"]
        assert 0.0 < first[0] <= result["seconds"] and first[1] <= result["samples"] == 960 and last is None
    assert "rsl_rl_lib" in content["versions"] and content["options"]["config"]["hidden"] == [8]
    assert lw.load(tmp_path / "kept" / "5.pt").nact == 1
