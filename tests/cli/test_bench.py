import subprocess
import sys
from pathlib import Path

import pytest
from training_runs import refused

from lyceum_warp import cli


@pytest.mark.long
def test_bench_forwards_options_and_returns_the_exit_code_of_the_program() -> None:
    command = [sys.executable, "-m", "lyceum_warp.cli", "bench", "plot", "no_experiment"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and "'no_experiment'" in done.stderr


def test_bench_refuses_unknown_programs_and_needs_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "throughputs"]) == 2
    refused(capsys, "'throughputs'", "throughput?")
    monkeypatch.setattr("lyceum_warp.cli.bench.FOLDER", tmp_path / "bench")
    assert cli.main(["bench"]) == 2
    refused(capsys, str(tmp_path / "bench"))
