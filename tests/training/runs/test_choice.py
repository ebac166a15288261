import json
import shutil
from pathlib import Path

import onnxruntime
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Run, read_checkpoint
from lyceum_warp.training.runs.checkpoints import policy_content, write_content


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Make a run whose best policy hops and whose last policy falls, with episodes of 50 steps."""
    folder = tmp_path / "run"
    shutil.copytree(lw.pretrained_run("hopper"), folder)
    run = Run.open(folder)
    run.amend(options={"horizon": 200})
    content = read_checkpoint(run.policy, parts=("policy",))
    write_content(run.best, {**content, "iteration": 3, "score": {"name": "mean_return", "value": 1.0}})
    torch.manual_seed(0)
    fallen = lw.GaussianPolicy(11, 3, log_std=0.0)
    write_content(run.policy, policy_content(5, fallen))
    return run


def test_better_policy_is_evaluated_exported_and_named(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run.folder), "--episodes", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (choice,) = [line for line in lines if line.startswith("policy: the best one")]
    assert "best (iteration 3) returns" in choice and "last (iteration 5) returns" in choice
    assert any("2 episodes of the mean policy 'best'" in line for line in lines)
    scores = json.loads(run.evaluation.read_text())["policies"]
    assert scores["best"]["mean"] > 2 * scores["last"]["mean"]

    run.evaluation.write_text(run.evaluation.read_text().replace('"mean"', '"other"'))  # a damaged file is replaced
    assert cli.main(["export", str(run.folder)]) == 0
    assert choice in capsys.readouterr().out
    obs = torch.randn(4, 11)
    (action,) = onnxruntime.InferenceSession(run.folder / "policy.onnx").run(["action"], {"obs": obs.numpy()})
    expected = lw.load(run, which="best").act(obs)
    torch.testing.assert_close(torch.from_numpy(action), expected, atol=1e-5, rtol=1e-5)


def test_choice_follows_new_policies(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run.folder), "--episodes", "2"]) == 0
    content = read_checkpoint(run.best, parts=("policy",))
    write_content(run.policy, {**content, "iteration": 8})
    capsys.readouterr()
    assert cli.main(["eval", str(run.folder), "--episodes", "2"]) == 0
    assert "policy: the last one; in 32 new episodes, last (iteration 8)" in capsys.readouterr().out
