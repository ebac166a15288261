"""Commands in this process: short training runs, their files, and the ends of commands."""

import csv
import signal
from pathlib import Path

import pytest

from lyceum_warp import cli

TINY = ["--samples", "512", "--nworld", "2", "--hidden", "8", "--value-hidden", "8", "--mean-every", "2",
        "--mean-episodes", "2"]  # fmt: skip
QUIET = ["--no-video", "--no-plot"]


def train(out: Path, *options: str, task: str = "point_mass") -> int:
    """The exit code of a short run."""
    return cli.main(["train", task, "--out", str(out), *TINY, *QUIET, *options])


def metrics(run: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv without measured times."""
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if "time" not in k and k != "samples_per_second"} for row in rows]


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> None:
    """The command wrote one line to stderr, which contains these words."""
    lines = capsys.readouterr().err.splitlines()
    (error,) = [line for line in lines if not line.startswith(("compiling kernels ", "  "))]
    assert error.startswith("lyceum-warp: ")
    for word in words:
        assert word in error


def interrupted(argv: list[str]) -> int:
    """The exit code of a command that gets a SIGINT; a signal that it does not handle fails this test only."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return cli.main(argv)
    except KeyboardInterrupt:
        pytest.fail("the command did not handle SIGINT")
    finally:
        signal.signal(signal.SIGINT, before)
