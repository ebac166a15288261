import json
from pathlib import Path

import experiment
import learning
import pytest


@pytest.mark.parametrize("algorithm", ["npg", "ppo"])
def test_learning_run_ends_at_its_target(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setitem(learning.TARGETS, "hopper", ("npg", 0.0, 8, 64, 1))
    monkeypatch.setattr(learning, "JUDGED", 2)
    out = tmp_path / "learning.jsonl"
    assert experiment.main(learning.EXPERIMENT, ["--short", "--out", str(out), "--algorithm", algorithm]) == 0
    result = json.loads(out.read_text())["result"]
    assert result["reached"] and result["curve"][-1][0] == result["samples"]
    assert result["curve"][-1][1] == pytest.approx(result["seconds"], abs=1e-4) and result["curve"][-1][2] >= 0.0
    assert f"| hopper | {algorithm.upper()} | 8 | 0 | 0 |" in capsys.readouterr().out


def test_standing_robot_has_tracking_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    import lyceum_warp as lw

    monkeypatch.setattr(learning, "WALKED", (8, 50))
    env = lw.make("go1_velocity", nworld=2)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    case = learning.Case("go1_velocity", "ppo", 0, 8, 80.0, 1.0, "cpu")
    errors = learning.walk(case, policy)
    assert 0.1 < errors["velocity_error"] < 2.0 and errors["falls_per_world_second"] >= 0.0


def test_learning_figure_is_drawn_from_stored_results(tmp_path: Path) -> None:
    rows = experiment.read(experiment.RESULTS / "learning.jsonl")
    walkers = [row for row in rows if row.case["task"] == "go1_velocity"]
    learning.figure(walkers).savefig(tmp_path / "learning.png")
    assert learning.figure([row for row in rows if row not in walkers]) is None
