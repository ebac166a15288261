from pathlib import Path

import pytest

from lyceum_warp.cli import main


@pytest.mark.long
def test_bench_forwards_options_and_returns_the_exit_code_of_the_program(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "plot", "no_experiment"]) == 2
    assert capfd.readouterr().err.startswith("plot: there is no experiment 'no_experiment': ")


def test_bench_refuses_unknown_programs(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "throughputs"]) == 2
    assert "there is no program 'throughputs' in bench/: did you mean throughput?" in capfd.readouterr().err


def test_bench_without_a_checkout_prints_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lyceum_warp.cli.bench.FOLDER", tmp_path / "bench")
    assert main(["bench"]) == 2
    assert "the experiments need a checkout of the repository" in capfd.readouterr().err
