import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp.cli import main

OLD = Path(__file__).parent.parent / "data" / "old_run"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLD, tmp_path / "run"))


def test_export_writes_a_policy_that_onnx_runtime_runs(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runtime = pytest.importorskip("onnxruntime")
    assert main(["export", str(run)]) == 0
    assert f"{run / 'policy.onnx'}: 11 observations, 3 actions, " in capsys.readouterr().out
    obs = np.random.default_rng(0).standard_normal((4, 11)).astype(np.float32)
    (action,) = runtime.InferenceSession(str(run / "policy.onnx")).run(["action"], {"obs": obs})
    np.testing.assert_allclose(action, lw.load(run)(torch.from_numpy(obs)).numpy(), rtol=1e-6, atol=1e-6)


def test_export_writes_to_the_given_path(run: Path, tmp_path: Path) -> None:
    assert main(["export", str(run), "--to", str(tmp_path / "robot" / "policy.pt2")]) == 0
    obs = torch.randn(3, 11)
    action = torch.export.load(tmp_path / "robot" / "policy.pt2").module()(obs)
    torch.testing.assert_close(action, lw.load(run)(obs))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--to", "policy.txt"], ["policy.txt must end with .onnx or .pt2"]),
        (["--which", "best"], ["best"]),
    ],
)
def test_invalid_input_of_export_prints_one_line(
    run: Path, options: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run), *options]) == 2
    refused(capsys, *words)
    assert not (run / "policy.onnx").exists()
