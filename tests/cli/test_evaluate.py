"""lyceum-warp eval."""

import json
import shutil
from pathlib import Path

import pytest
import warp as wp
from training_runs import metrics, refused, train

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos.evaluation import MEAN_SEED
from lyceum_warp.runs import load


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "two"
    assert train(out, "--iterations", "2") == 0
    return out


def test_a_run_from_a_gpu_is_evaluated_anywhere(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    config |= {"device": "cuda:7", "params": config["params"] | {"nconmax": 16}}
    (run / "config.json").write_text(json.dumps(config))
    assert cli.main(["eval", str(run), "--episodes", "2"]) == 0
    assert "2 episodes of the mean policy" in capsys.readouterr().out
    assert cli.main(["eval", str(run), "--episodes", "2", "--engine", "warp"]) == 2
    assert "no device 'cuda:7'" in capsys.readouterr().err


def test_eval_prints_statistics_of_the_seeds_episodes(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = []
    for seed in ("7", "7", "8"):
        assert cli.main(["eval", str(trained), "--episodes", "3", "--seed", seed, "--nworld", "2"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1] != outputs[2]
    assert "3 episodes of the mean policy" in outputs[0]
    lines = {line.split()[0]: line.split() for line in outputs[0].splitlines() if line.split()}
    assert lines["length"] == ["length", "256", "0", "256", "256"]
    mean, std, low, high = (float(number) for number in lines["return"][1:])
    assert low <= mean <= high
    assert std > 0
    assert "success:" in lines


def test_eval_refuses_no_episodes_and_folders_without_a_run(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(trained), "--episodes", "0"]) == 2
    refused(capsys, "at least 1 episode")
    assert cli.main(["eval", str(trained.parent)]) == 2
    refused(capsys, "there is no run in")


def test_the_loaded_policy_is_the_trained_one(trained: Path) -> None:
    policy = load(trained)
    env = lw.make("point_mass", nworld=2)
    episodes = lw.evaluate(env, policy, 2, seed=MEAN_SEED)
    assert repr(episodes.returns.mean().item()) == metrics(trained)[-1]["mean_return"]


@pytest.mark.gpu
def test_gpu_a_run_trains_and_is_evaluated_on_the_cpu(tmp_path: Path) -> None:
    assert wp.is_cuda_available()
    assert train(tmp_path / "run", "--device", "cuda", "--iterations", "2") == 0
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2", "--device", "cpu"]) == 0
