"""Load, evaluate and resume runs that release 0.2.0 wrote.

Each run is as after kill -9: metrics.csv has three iterations, and the checkpoint has two.
"""

import shutil
from pathlib import Path

import pytest
import torch
from training_runs import QUIET

import lyceum_warp as lw
from lyceum_warp.cli import main

DATA = Path(__file__).parent.parent.parent / "data" / "runs_0_2"
# another CPU rounds differently, and NPG's conjugate gradients of a few samples amplify this
AMPLIFIED = dict.fromkeys(("kl", "std_mean", "step_norm", "step_fraction"), 0.1)


@pytest.fixture(params=["npg", "ppo", "sac", "task_file"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> lw.Run:
    return lw.Run.open(shutil.copytree(DATA / request.param, tmp_path / "run"))


def numbers(run: lw.Run) -> list[dict[str, float]]:
    """Return the rows of metrics.csv without measured times."""
    measured = ("time_", "samples_per_second")
    return [
        {name: value for name, value in row.items() if value is not None and not name.startswith(measured)}
        for row in run.rows()
    ]


def code(run: lw.Run) -> list[str]:
    """Return the file of the task, which is not where it was, and which this machine has not run."""
    copy = run.task_folder / "slide.py"
    return [str(copy)] if copy.exists() else []


def test_run_of_release_0_2_is_loaded_and_evaluated(run: lw.Run, capsys: pytest.CaptureFixture[str]) -> None:
    policy, value = lw.load(run), lw.load_value(run)
    obs = torch.zeros(2, policy.nobs)
    assert policy.act(obs).shape == (2, policy.nact)
    argument = torch.zeros(2, policy.nact) if run.config["algorithm"] == "sac" else torch.zeros(2)
    assert value(obs, argument).isfinite().all()
    task = ["--task", *code(run)] if code(run) else []
    assert main(["eval", str(run.folder), *task, "--episodes", "2"]) == 0
    assert "2 episodes of the mean policy" in capsys.readouterr().out


def test_run_of_release_0_2_is_resumed_with_the_same_result(run: lw.Run, tmp_path: Path) -> None:
    before = numbers(run)
    assert main(["train", *code(run), "--resume", str(run.folder), "--iterations", "3", *QUIET]) == 0
    after = lw.Run.open(run.folder)
    assert after.read()["iteration"] == 3
    for new, old in zip(numbers(after), before, strict=True):
        assert new.keys() == old.keys()
        for name, number in old.items():
            assert new[name] == pytest.approx(number, rel=AMPLIFIED.get(name, 1e-3), abs=1e-5, nan_ok=True), name
    algorithm = run.config["algorithm"]
    assert after.config[algorithm] == run.config[algorithm]
    out = tmp_path / "out"
    assert main(["train", "--from", str(run.folder), "--out", str(out), "--iterations", "1", *QUIET]) == 0
    config = lw.Run.open(out).config
    assert config[algorithm].items() >= run.config[algorithm].items() and config["from"]["iteration"] == 3
