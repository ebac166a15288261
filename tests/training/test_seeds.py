import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from training_runs import QUIET, TINY, metrics, refused, train

import lyceum_warp as lw
from lyceum_warp import cli, training
from lyceum_warp.support.intervals import bootstrap_interval, interquartile_mean
from lyceum_warp.training import flag_words

WORDS = ["point_mass", *TINY, *QUIET, "--iterations", "3"]


def test_seeds_side_by_side_equal_single_runs_and_are_summarised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", *WORDS, "--seeds", "0", "3", "--jobs", "2", "--out", str(tmp_path / "both")]) == 0
    for seed in ("0", "3"):
        assert train(tmp_path / seed, "--iterations", "3", "--seed", seed) == 0
        assert metrics(tmp_path / "both" / f"seed-{seed}") == metrics(tmp_path / seed)
    assert (tmp_path / "both" / "curves.png").stat().st_size > 1000
    mean = np.mean([float(metrics(tmp_path / seed)[-2]["mean_return"]) for seed in ("0", "3")])
    shown = capsys.readouterr().out
    assert f"{mean:.5g} [" in shown and "lyceum-warp plot" in shown


@pytest.mark.long  # tests/cli/test_train.py covers --continue
def test_interrupted_seeds_continue_with_the_same_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = [sys.executable, "-m", "lyceum_warp.cli", "train", *WORDS[:-1], "400", "--seeds", "1", "--out", "x"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    while not (tmp_path / "x" / "seed-0" / "metrics.csv").exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 128 + signal.SIGTERM
    done = len(metrics(tmp_path / "x" / "seed-0"))
    assert done < 400
    monkeypatch.chdir(tmp_path)
    runs = lw.train_seeds(
        "point_mass", "x", 1, iterations=done + 1, samples=512, nworld=2, hidden=(8,), value_hidden=(8,), mean_every=2,
        mean_episodes=2, plot=False,
    )  # fmt: skip
    assert [run.state for run in runs] == ["complete"]
    assert len(metrics(tmp_path / "x" / "seed-0")) == done + 1


LEARNER = """
import lyceum_warp as lw

class Fragile(lw.NPG):
    def __init__(self, env, *networks, seed=0, **options):
        if seed == 1:
            raise ValueError("seed 1 is refused")
        super().__init__(env, *networks, seed=seed, **options)

    def __next__(self):
        if self.seed == 0:
            raise RuntimeError("seed 0 breaks")
        return super().__next__()
"""


@pytest.mark.long
def test_failed_seeds_say_why_and_an_exception_of_watch_ends_the_others(tmp_path: Path) -> None:
    (tmp_path / "fragile.py").write_text(LEARNER)
    seen: list[Sequence[training.SeedRun]] = []

    def watch(runs: Sequence[training.SeedRun]) -> None:
        seen[:] = [runs]
        if (runs[2].folder / "metrics.csv").exists():
            raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        lw.train_seeds(
            "point_mass", tmp_path / "x", 3, watch=watch, algorithm=f"{tmp_path}/fragile.py:Fragile", iterations=10_000,
            nworld=2, plot=False,
        )  # fmt: skip
    assert [run.state for run in seen[0]] == ["failed", "failed", "training"]
    assert [run.error for run in seen[0]] == ["RuntimeError: seed 0 breaks", "seed 1 is refused", ""]
    assert "interrupted by SIGTERM" in seen[0][2].folder.with_suffix(".log").read_text()


def test_command_prints_the_table_if_all_seeds_have_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = training.SeedRun(0, tmp_path / "seed-0", "failed", "it breaks")
    monkeypatch.setattr(training, "train_seeds", lambda *words, watch, **settings: watch([failed]) or [failed])
    assert cli.main(["train", "point_mass", "--seeds", "1", "--out", str(tmp_path)]) == 1
    shown = capsys.readouterr()
    assert "it breaks" in shown.out and shown.err == ""


@pytest.mark.long
def test_bad_options_are_refused_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["train", *WORDS, "--seeds", "3", "--jobs", "2", "--out", str(tmp_path / "x")]
    assert cli.main([*argv, "--gamma", "7"]) == 2
    refused(capsys, "gamma must be")
    assert not (tmp_path / "x").exists()
    assert cli.main([*argv, "--param", "speed=1"]) == 2
    refused(capsys, "no parameter 'speed'")
    assert not (tmp_path / "x").exists()
    ppo = ["--algorithm", "ppo", "--nworld", "2", "--num-steps", "4", "--minibatches", "100"]
    assert cli.main(["train", "point_mass", *ppo, *argv[-6:]]) == 2  # only the learner refuses these
    refused(capsys, "100 mini-batches")
    assert not (tmp_path / "x").exists()


def test_options_become_words_of_the_command_line() -> None:
    settings = {"hidden": (8, 8), "plot": False, "param": {"gain": 2.0, "goal": [1, 2]}, "camera": ("a=1", "b=2")}
    words = "--hidden 8 8 --no-plot --param gain=2.0 --param goal=1,2 --camera a=1 --camera b=2"
    assert " ".join(flag_words(settings)) == words


def test_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    values = np.array([100.0, 1.0, 2.0, 3.0, -50.0])
    assert interquartile_mean(values) == 2.0
    low, high = bootstrap_interval(np.arange(40.0), interquartile_mean)
    assert 8 < low < 19.5 < high < 31
