"""The programs that measure seconds to mean rewards, and how well a policy walks."""

import csv
import json
import runpy
import sys
from pathlib import Path

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.runs.checkpoints import policy_content, write_content

BENCH = Path(__file__).parents[2] / "bench"
METERED = Path(__file__).parents[1] / "metered_task.py"
SMALL = {
    "ppo": ["--ppo.hidden", "8", "--ppo.value-hidden", "8", "--ppo.num-steps", "40"],
    "npg": ["--npg.hidden", "8", "--npg.value-hidden", "8", "--npg.samples", "320"],
}


def run(monkeypatch: pytest.MonkeyPatch, program: str, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", [program, *map(str, words)])
    monkeypatch.syspath_prepend(str(BENCH))
    runpy.run_path(str(BENCH / program), run_name="__main__")


@pytest.mark.parametrize("algorithm", SMALL)
def test_seconds_to_mean_rewards_are_printed_and_written(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "seconds.csv"
    options = ["--nworld", "8", "--iterations", "3", "--seeds", "4", "5", "--targets", "-1e6", "1e6"]
    files = ["--out", out, "--keep", tmp_path / "kept"]
    run(monkeypatch, "time_to_reward.py", METERED, "--algorithm", algorithm, *options, *SMALL[algorithm], *files)
    assert "seed 5, s" in capsys.readouterr().out
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["4"] * 3 + ["5"] * 3 and "metrics/effort" in rows[0]
    content = json.loads(out.with_suffix(".json").read_text())
    for result in content["rows"]:
        first, last = result["reached"]["-1e+06"], result["reached"]["1e+06"]
        assert 0.0 < first[0] <= result["seconds"] and first[1] <= result["samples"] == 960 and last is None
    assert content["options"][algorithm]["hidden"] == [8]
    assert lw.load(tmp_path / "kept" / "5.pt").nact == 1


def test_walking_measures_what_the_task_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "still.pt", tmp_path / "walking.json"
    env = lw.make("go1_velocity", nworld=2)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=64, mean_every=0, log_std=-2.0))
    write_content(path, policy_content(0, npg.policy, npg.value))
    run(monkeypatch, "walking.py", path, "--nworld", 8, "--steps", 100, "--seed", 3, "--out", out)
    assert "rad/s" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())["rows"]

    env = lw.make("go1_velocity", nworld=8, seed=3)
    errors, falls = torch.zeros(8), 0
    with torch.no_grad():
        for _ in range(100):
            env.step(npg.policy(env.obs))
            errors += env.metrics["velocity_error"]
            falls += int(env.terminated.sum())
    assert row["velocity_error"] == pytest.approx(errors.mean().item() / 100, rel=1e-5)
    assert row["falls_per_world_second"] == pytest.approx(falls / (8 * 100 * 0.02))
