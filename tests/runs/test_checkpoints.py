"""Files with policies and states: those that are broken, foreign or missing."""

from pathlib import Path

import pytest
import torch

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.runs.checkpoints import FORMAT
from lyceum_warp.runs.folder import Run, load


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", {})
    run.save(0, GaussianPolicy(3, 2, (8, 4), normalize=True), {"counter": 5})
    return run


class Foreign:
    """A class whose instances a checkpoint must not contain."""


@pytest.mark.parametrize("kind", ["empty", "truncated", "text", "foreign", "code", "list", "newer", "partial", "shape"])
def test_broken_and_foreign_checkpoints_are_refused_in_one_line(run: Run, kind: str) -> None:
    path, whole = run.checkpoint, run.checkpoint.read_bytes()
    content = run.read()
    fix = "restore the file from a copy, or train again into another folder"
    match kind:
        case "empty":
            path.write_bytes(b"")
        case "truncated":
            path.write_bytes(whole[: len(whole) // 2])
        case "text":
            path.write_text("weights: 1, 2, 3\n")
        case "foreign":
            torch.save({"model": torch.zeros(2)}, path)
        case "code":
            torch.save({"lyceum_warp": FORMAT, "policy": Foreign()}, path)
        case "list":
            torch.save([1, 2], path)
        case "newer":
            torch.save(content | {"lyceum_warp": FORMAT + 1}, path)
            fix = "pip install --upgrade lyceum-warp"
        case "partial":
            del content["policy"]
            torch.save(content, path)
        case "shape":
            content["policy"]["shape"]["nobs"] = 4
            torch.save(content, path)
    with pytest.raises(ValueError, match=fix) as caught:
        load(run)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_checkpoint_is_reported(run: Run) -> None:
    run.checkpoint.unlink()
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*checkpoint\.pt: train the run first"):
        load(run)
