"""Start short training runs from the command line and in Python."""

import csv
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Configuration, Run, run_env

TINY = ["--samples", "512", "--nworld", "2", "--hidden", "8", "--value-hidden", "8", "--mean-every", "2",
        "--mean-episodes", "2"]  # fmt: skip
QUIET = ["--no-video", "--no-plot"]


def train(out: Path, *options: str, task: str = "point_mass") -> int:
    return cli.main(["train", task, "--out", str(out), *TINY, *QUIET, *options])


def metrics(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if "time" not in k and k != "samples_per_second"} for row in rows]


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> None:
    """Check that the command wrote one line with these words to stderr."""
    lines = capsys.readouterr().err.splitlines()
    (error,) = [line for line in lines if not line.startswith("compiling kernels ")]
    assert error.startswith("lyceum-warp: ")
    for word in words:
        assert word in error


def interrupted(argv: list[str]) -> int:
    """Run a command that must handle SIGINT, and return its exit code."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return cli.main(argv)
    except KeyboardInterrupt:
        pytest.fail("the command did not handle SIGINT")
    finally:
        signal.signal(signal.SIGINT, before)


CONFIG = lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,), mean_every=2, mean_episodes=2)


def algorithm(env: lw.Env, **options: Any) -> lw.NPG:
    return lw.NPG(env, config=CONFIG, **options)


def six_iterations(folder: Path) -> Path:
    lw.train(algorithm(lw.make("point_mass", nworld=2)), folder, 6, keep_every=2)
    return folder


def env_of(folder: Path) -> lw.Env:
    run = Run.open(folder)
    configuration = Configuration.of(run)
    return run_env(run, configuration.options, configuration.params)


def mean_action(policy: lw.GaussianPolicy) -> torch.Tensor:
    return policy(torch.linspace(-1.0, 1.0, policy.nobs))
