import shutil
from pathlib import Path

import pytest
import torch
from training_runs import QUIET

import lyceum_warp as lw
from lyceum_warp.cli import main
from lyceum_warp.training import Run

DATA = Path(__file__).parent.parent.parent / "data"


@pytest.mark.parametrize("gamma", [0.9, 0.995])
def test_value_function_of_an_old_run_gets_the_old_scale(gamma: float, tmp_path: Path) -> None:
    """The old run lacks the scale, which was 1 / (1 - gamma)."""
    old_run = Path(shutil.copytree(DATA / "old_run", tmp_path / "run"))
    content = torch.load(old_run / "checkpoint.pt", weights_only=True)
    content["value"]["shape"] |= {"scale": 1.0 / (1.0 - gamma), "discount": gamma}
    torch.save(content, old_run / "checkpoint.pt")
    run = Run.open(old_run)
    saved = run.config["npg"] | {"gamma": gamma, "hidden": (8,), "value_hidden": (8,)}
    run.amend(npg=saved)
    npg = lw.NPG(lw.make("hopper", nworld=4, integrator="euler"), config=lw.NPGConfig(**saved))
    npg.load_state_dict(run.read()["state"])
    obs, step = torch.linspace(-1.0, 1.0, 22).view(2, 11), torch.zeros(2)
    torch.testing.assert_close(npg.value(obs, step), lw.load_value(old_run)(obs, step))
    # early releases multiplied the network's output by this factor
    plain = npg.value.network(obs).squeeze(-1) / (1.0 - gamma)
    torch.testing.assert_close(npg.value(obs, step), plain)


@pytest.fixture(params=["old_run", "runs_0_1/command", "runs_0_1/python", "runs_0_1/task_file"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A run of two iterations, made by release 0.1 or an earlier version."""
    return Path(shutil.copytree(DATA / request.param, tmp_path / "run"))


def test_run_of_an_early_release_is_loaded_and_evaluated(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = lw.load(run)
    obs, value = torch.zeros(2, policy.nobs), lw.load_value(run)
    assert policy.act(obs).shape == (2, policy.nact)
    assert value(obs, torch.zeros(2)).shape == (2,) and value.discount == 0.995
    assert main(["eval", str(run), "--trust", "--episodes", "2"]) == 0
    assert "2 episodes of the mean policy" in capsys.readouterr().out


def test_run_of_an_early_release_can_be_resumed_and_can_start_a_new_run(run: Path, tmp_path: Path) -> None:
    before = Run.open(run)
    assert main(["train", "--resume", str(run), "--trust", "--iterations", "4", *QUIET]) == 0
    after = Run.open(run)
    assert [row["iteration"] for row in after.rows()] == [1, 2, 3, 4] and after.read()["iteration"] == 4
    assert after.config["npg"] == before.config["npg"]
    out = tmp_path / "out"
    assert main(["train", "--from", str(run), "--out", str(out), "--iterations", "1", *QUIET]) == 0
    config = Run.open(out).config
    assert config["npg"].items() >= before.config["npg"].items() and config["from"]["iteration"] == 4


@pytest.fixture
def rsl_rl_run(tmp_path: Path) -> Path:
    """A run of PPO in rsl_rl. Early releases named this algorithm rsl-rl."""
    return Path(shutil.copytree(DATA / "rsl_rl_run", tmp_path / "rsl_rl"))


def test_run_of_rsl_rl_is_loaded_evaluated_and_exported(rsl_rl_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy, value = lw.load(rsl_rl_run), lw.load_value(rsl_rl_run)
    obs = torch.linspace(-9.0, 9.0, 12).view(2, 6)
    assert policy.act(obs).shape == (2, 2) and value(obs, torch.zeros(2)).shape == (2,)
    assert policy.normalizer.count == 96 and value.discount == 0.99
    assert main(["eval", str(rsl_rl_run), "--episodes", "2"]) == 0
    assert "point_mass: 2 episodes of the mean policy" in capsys.readouterr().out
    assert main(["export", str(rsl_rl_run), "--to", str(rsl_rl_run / "policy.pt2")]) == 0
    exported = torch.export.load(rsl_rl_run / "policy.pt2").module()
    torch.testing.assert_close(exported(obs), policy(obs))


def test_ppo_continues_from_a_run_of_rsl_rl(
    rsl_rl_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, begin = tmp_path / "new", ["train", "--from", str(rsl_rl_run), "--iterations", "1"]
    assert main(begin) == main(["train", "--resume", str(rsl_rl_run), "--iterations", "5"]) == 2
    assert "was trained by 'rsl-rl', which is not part of this package" in capsys.readouterr().err
    settings = ["--algorithm", "ppo", "--num-steps", "12", "--hidden", "8", "--out", str(out)]
    assert main([*begin, *settings, *QUIET]) == 0
    run = Run.open(out)
    assert run.config["algorithm"] == "ppo" and run.config["from"]["iteration"] == 2
    new, old = lw.load(out), lw.load(rsl_rl_run)
    assert new.normalizer.count == 96 + 48
    change = (new.network[0].weight - old.network[0].weight).abs().max()
    assert 0.0 < change < 0.1
    ppo = lw.PPO(lw.make("point_mass", nworld=4), old, lw.load_value(rsl_rl_run), lw.PPOConfig(num_steps=12))
    assert next(ppo).kl > 0.0  # also from Python
