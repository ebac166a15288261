import shutil
from pathlib import Path

import pytest
from training_runs import refused

from lyceum_warp.cli import main

OLD = Path(__file__).parent.parent / "data" / "old_run"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLD, tmp_path / "run"))


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
