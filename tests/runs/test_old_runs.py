"""Runs of earlier releases load, are evaluated and resume."""

import shutil
from pathlib import Path

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.cli import main
from lyceum_warp.runs.folder import Run
from lyceum_warp.training import restore

OLD = Path(__file__).parent.parent / "data" / "old_run"


@pytest.fixture
def old_run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLD, tmp_path / "run"))


def test_the_policy_and_the_value_function_of_an_old_run_load(old_run: Path) -> None:
    policy, value = lw.load(old_run), lw.load_value(old_run)
    assert policy(torch.zeros(2, policy.nobs)).shape == (2, 3)
    assert value(torch.zeros(2, policy.nobs), torch.zeros(2)).shape == (2,)
    assert value.discount == 0.995


def test_an_old_run_is_evaluated_in_its_own_physics(old_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(old_run), "--episodes", "2"]) == 0
    assert "hopper: 2 episodes of the mean policy" in capsys.readouterr().out


def test_an_old_run_resumes_with_all_its_settings(old_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", "--resume", str(old_run), "--iterations", "3", "--no-video", "--no-plot"]
    assert main(arguments) == 0
    assert [row["iteration"] for row in Run.open(old_run).rows()] == [1, 2, 3]
    out = capsys.readouterr().out
    assert "4 worlds, mujoco engine on cpu" in out


@pytest.mark.parametrize("gamma", [0.9, 0.995])
def test_the_value_function_of_an_old_run_keeps_its_scale(gamma: float, old_run: Path) -> None:
    """Its file lacks the scale, which was 1 / (1 - gamma)."""
    content = torch.load(old_run / "checkpoint.pt", weights_only=True)
    content["value"]["shape"] |= {"scale": 1.0 / (1.0 - gamma), "discount": gamma}
    torch.save(content, old_run / "checkpoint.pt")
    run = Run.open(old_run)
    saved = run.config["npg"] | {"gamma": gamma, "hidden": (8,), "value_hidden": (8,)}
    run.amend(npg=saved)
    npg = lw.NPG(lw.make("hopper", nworld=4, integrator="euler"), config=lw.NPGConfig(**saved))
    restore(run, npg, run.read())
    obs, step = torch.linspace(-1.0, 1.0, 22).view(2, 11), torch.zeros(2)
    torch.testing.assert_close(npg.value(obs, step), lw.load_value(old_run)(obs, step))
    # before the release that scales to the returns, a prediction was the network's output times this factor
    plain = npg.value.network(obs).squeeze(-1) / (1.0 - gamma)
    torch.testing.assert_close(npg.value(obs, step), plain)
