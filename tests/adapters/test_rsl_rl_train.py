"""lyceum-warp train --algorithm rsl-rl, and the other commands with its runs."""

import csv
import importlib.metadata
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from memory_window import MemoryWindow
from training_runs import QUIET, interrupted, metrics, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos.distributed import Team
from lyceum_warp.cli.train import Train, _config
from lyceum_warp.runs.folder import Run
from lyceum_warp.viewer import show as views

METERED = str(Path(__file__).parent.parent / "metered_task.py")
TINY = ["--algorithm", "rsl-rl", "--nworld", "4", "--horizon", "10", "--config.hidden", "8", "--config.value-hidden",
        "8", "--config.num-steps-per-env", "12", "--config.mean-every", "2", "--config.mean-episodes", "2"]  # fmt: skip


def train(out: Path, *options: str) -> int:
    return cli.main(["train", METERED, "--out", str(out), *TINY, *QUIET, *options])


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "four"
    assert train(out, "--iterations", "4", "--keep-every", "2") == 0
    return out


def test_the_run_is_shown_and_written_like_every_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    options = [option for option in TINY if option != "--no-plot"]
    arguments = ["train", METERED, "--out", str(out), *options, "--iterations", "3", "--no-video", "--tensorboard"]
    assert cli.main(arguments) == 0
    shown = capsys.readouterr().out
    assert "segments of 12 steps for rsl_rl's PPO; run in" in shown and "iteration    3/3" in shown
    assert "mean policy, 32 new episodes: return" in shown and "Actor Model" not in shown
    assert {path.name for path in out.iterdir() if "tfevents" not in path.name} >= {
        "config.json", "versions.json", "metrics.csv", "policy.pt", "best.pt", "checkpoint.pt", "task",
    }  # fmt: skip
    assert list(out.glob("events.out.tfevents.*"))
    with (out / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["samples"] for row in rows] == ["48", "96", "144"]
    assert json.loads((out / "versions.json").read_text())["rsl_rl_lib"] == importlib.metadata.version("rsl-rl-lib")
    assert {"return_mean", "return_recent", "mean_return", "kl", "value_loss", "time_update", "metrics/effort"} <= set(
        rows[0]
    )


def test_a_resumed_run_equals_an_uninterrupted_one(four: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert train(out, "--iterations", "2", "--keep-every", "2") == 0
    assert cli.main(["train", "--resume", str(out), "--iterations", "4", *QUIET]) == 0
    assert metrics(out) == metrics(four)
    assert Run.open(out).config == Run.open(four).config


def test_an_interrupted_run_continues(four: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"

    def interrupt() -> None:
        end = time.monotonic() + 60.0
        while time.monotonic() < end:
            if (out / "metrics.csv").exists() and len(metrics(out)) >= 3:
                break
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    arguments = ["train", METERED, "--out", str(out), *TINY, *QUIET, "--iterations", "100000"]
    assert interrupted(arguments) == 130
    done = Run.open(out).read()["iteration"]
    assert f"interrupted by SIGINT after {done} of 100000 iterations" in capsys.readouterr().out
    assert cli.main(["train", "--resume", str(out), "--iterations", str(done + 1), *QUIET]) == 0
    rows, known = metrics(out), metrics(four)  # of short iterations, the last few may be lost
    assert len(rows) == done + 1 and rows[:4] == known[: len(rows)]


def test_a_run_is_evaluated_exported_viewed_and_planned_with(
    four: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", str(four), "--episodes", "2", "--which", "2", "--episodes-to", str(tmp_path / "e")]) == 0
    assert "effort" in capsys.readouterr().out and len(list((tmp_path / "e").glob("*.npz"))) == 2
    assert cli.main(["export", str(four), "--to", str(tmp_path / "policy.pt2")]) == 0
    obs = torch.linspace(-30.0, 30.0, 5).unsqueeze(-1)
    exported = torch.export.load(tmp_path / "policy.pt2").module()(obs)
    torch.testing.assert_close(exported, lw.load(four)(obs))
    monkeypatch.setattr(views, "opened", lambda *a, **o: MemoryWindow(lambda frame, number: None if number else []))
    for words in ([], ["--follow"]):
        assert cli.main(["view", str(four), "--nworld", "2", *words]) == 0
    plan = ["plan", METERED, "--steps", "2", "--samples", "4", "--out", str(tmp_path / "plan")]
    assert cli.main([*plan, "--value", str(four), *QUIET]) == 0


def test_a_run_begins_with_the_networks_of_another(four: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert (
        cli.main(["train", "--from", str(four), "--out", str(out), "--iterations", "1", "--param", "far=2", *QUIET])
        == 0
    )
    config = Run.open(out).config
    assert config["rsl-rl"] == Run.open(four).config["rsl-rl"] | {"value_group": "critic"}
    assert config["from"]["iteration"] == 4
    assert config["params"] == {"far": 2}
    assert cli.main(["train", "--resume", str(out), "--iterations", "2", *QUIET]) == 0


def test_a_run_of_npg_goes_on_from_the_networks_of_rsl_rl(four: Path, tmp_path: Path) -> None:
    """Their normaliser does not clip, also after the run is resumed."""
    env = lw.make(METERED, nworld=2, horizon=10)
    npg = lw.NPG(env, lw.load(four), lw.load_value(four), lw.NPGConfig(samples=40, mean_every=0))
    folder = lw.train(npg, tmp_path / "run", iterations=1).folder
    assert cli.main(["train", "--resume", str(folder), "--iterations", "2", *QUIET]) == 0
    policy, far = lw.load(folder), torch.tensor([[1e4], [1e6]])
    assert policy.normalizer.limit == float("inf") and not torch.equal(*policy(far))


def test_a_target_return_ends_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train(tmp_path / "run", "--iterations", "9", "--target-return", "-1e9") == 0
    assert "the target return is reached" in capsys.readouterr().out
    assert len(metrics(tmp_path / "run")) == 2  # the first evaluation of the mean policy


@pytest.mark.parametrize("options, message", [
    (["--samples", "50"], "--samples is a setting of npg, not of rsl-rl: leave it out, or give --algorithm npg"),
    (["--config.gamma", "2"], "gamma must be a finite number from 0 to 1, not 2.0"),
    (["--config.num-mini-batches", "99"], "99 mini-batches are more than the 48 samples"),
    (["--algorithm", "npg"], "--config.num-steps-per-env is a setting of rsl-rl, not of npg: leave it out, or give"),
])  # fmt: skip
def test_wrong_settings_are_refused_before_the_folder_is_made(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", *options) == 2
    refused(capsys, message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("options, message", [
    (["--resume", "RUN", "--algorithm", "npg"], "has algorithm rsl-rl, not npg, and a run keeps its settings"),
    (["--resume", "RUN", "--iterations", "9", "--config.lam", "0.9"], "has lam 0.95, not 0.9, and a run keeps"),
    (["--resume", "RUN", "--iterations", "9", "--samples", "50"], "--samples is a setting of npg, not of rsl-rl"),
    (["--from", "RUN", "--algorithm", "npg"], "was trained by rsl-rl, and --from begins with a run of the same alg"),
    (["--from", "RUN", "--config.hidden", "9"], "have hidden (8,), not (9,): leave out --config.hidden"),
    (["--from", "RUN", "--config.value-group", "policy"],
     "have value_group critic, not policy: leave out --config.value-group"),
])  # fmt: skip
def test_settings_of_another_run_are_refused(
    four: Path, options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", *[str(four) if word == "RUN" else word for word in options], *QUIET]) == 2
    refused(capsys, message)
    assert not (tmp_path / "runs").exists()


def test_a_broken_configuration_is_one_line(four: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for changes, message in (
        ({"rsl-rl": {"momentum": 0.9}}, "config.json is not the configuration of an rsl-rl run ("),
        ({"algorithm": "other"}, "config.json is not the configuration of a training run"),
    ):
        run = Path(shutil.copytree(four, tmp_path / "run", dirs_exist_ok=True))
        content = json.loads((four / "config.json").read_text()) | changes
        (run / "config.json").write_text(json.dumps(content))
        assert cli.main(["train", "--resume", str(run), "--iterations", "9"]) == 2
        refused(capsys, message)


@pytest.mark.parametrize("release", [None, "6.0.0"])
def test_what_is_not_installed_is_one_line(
    release: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    version = importlib.metadata.version

    def changed(name: str) -> str:
        if name == "rsl-rl-lib" and release is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return release or version(name) if name == "rsl-rl-lib" else version(name)

    monkeypatch.setattr(importlib.metadata, "version", changed)
    assert train(tmp_path / "run") == 2
    refused(capsys, "rsl-rl-lib", "and 6.0.0 is installed" if release else "needs the package", "lyceum-warp[rsl-rl]")
    assert not (tmp_path / "run").exists()


def test_several_processes_are_refused() -> None:
    with pytest.raises(
        ValueError, match="--algorithm rsl-rl learns in one process, not in 2: start it without torchrun"
    ):
        _config(Train(task="hopper", algorithm="rsl-rl"), Team(0, 2))


def test_hyperparameters_are_shown_by_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    shown = capsys.readouterr().out
    assert all(flag in shown for flag in ("--algorithm {npg,rsl-rl}", "--config.num-steps-per-env", "--config.hidden"))
