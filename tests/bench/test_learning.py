import json
from pathlib import Path

import experiment
import gate
import learning
import pytest

import lyceum_warp as lw


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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = lw.PPOConfig(hidden=(4,), value_hidden=(4,), num_steps=4, mean_every=0)
    learner = lw.PPO(lw.make("go1_velocity", nworld=2), config=config)
    return lw.train(learner, tmp_path_factory.mktemp("gate") / "run", 1).folder


def test_experiment_gate_evaluates_each_policy_only_once(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--short", "--policy", str(run), "--out", str(tmp_path / "gate.jsonl")]
    assert experiment.main(gate.EXPERIMENT, arguments) == 0
    out = capsys.readouterr().out
    assert "| falls in 100 episodes of 20 s | " in out and "does not pass" in out
    assert experiment.main(gate.EXPERIMENT, arguments) == 0
    assert "1 of 1 cases are stored" in capsys.readouterr().out
