import json
from pathlib import Path

import onnxruntime
import pytest
import torch
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos import check_sizes
from lyceum_warp.binding import task_names
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.training import Run, load, pretrained_run
from lyceum_warp.training.runs.pretrained_runs import pretrained_tasks

TASKS = pretrained_tasks()


@pytest.mark.quick("cartpole_swingup", "go1_rough_velocity", "go1_velocity", "hopper")
@pytest.mark.parametrize("task", TASKS)
def test_pretrained_policy_matches_its_task_and_reaches_its_return(task: str) -> None:
    if task.startswith("dm/"):
        pytest.importorskip("dm_control", reason="dm_control brings the models")
    run = Run.open(pretrained_run(task))
    first = run.config["evaluated"]["first_steps"]
    env = run_worlds(run, {}, {}, nworld=first["worlds"])
    policy = load(run)
    check_sizes(policy, env)
    env.rand_reset(run.config["evaluated"]["seed"])
    total = torch.zeros(env.nworld)
    for _ in range(first["steps"]):
        env.action.copy_(policy.act(env.obs))
        env.step()
        total += env.reward
    assert total.mean().item() == pytest.approx(first["return"], rel=0.1)


def test_pretrained_policies_are_small_and_contain_no_code() -> None:
    size = 0
    for task in TASKS:
        folder = pretrained_run(task)
        assert {path.name for path in folder.iterdir()} == {"config.json", "policy.pt"}
        size += sum(path.stat().st_size for path in folder.iterdir())
        config = json.loads((folder / "config.json").read_text())
        assert config["task"] == config["kept"]["name"] == task and task in task_names()
        assert "file" not in config["kept"]
        assert all(type(value) in (int, float, list) for value in config["params"].values())
        content = torch.load(folder / "policy.pt", weights_only=True)
        assert content.keys() == {"lyceum_warp", "iteration", "policy"}
        assert lw.load(folder).training is False
    assert size < 8e6  # the wheel stays below 10 MB


def test_task_name_in_place_of_a_run_names_the_pretrained_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no run in hopper: .* add --pretrained, .*pretrained_run\('hopper'\)"):
        Run.open("hopper")
    with pytest.raises(FileNotFoundError, match="no run in runs/hopper, which does not exist"):
        Run.open("runs/hopper")


def test_eval_runs_a_pretrained_policy(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", "hopper", "--pretrained", "--episodes", "2", "--horizon", "20"]) == 0
    assert "2 episodes of the mean policy pretrained by" in capsys.readouterr().out


def test_pretrained_policy_is_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "hopper", "--pretrained"]) == 0
    assert capsys.readouterr().out.startswith("hopper.onnx: 11 observations, 3 actions")
    session = onnxruntime.InferenceSession(tmp_path / "hopper.onnx")
    assert session.get_modelmeta().custom_metadata_map["task"] == '"hopper"'


@pytest.mark.parametrize("command", ["eval", "export", "view"])
def test_task_without_a_pretrained_policy_prints_an_error(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "soft_ball", "--pretrained"]) == 2
    refused(capsys, "there is no pretrained policy of 'soft_ball': the tasks with a policy are ", ", hopper")
