import json
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from training_runs import QUIET, algorithm, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.viz import renderer

SMALL = lw.NPGConfig(samples=12, hidden=(4,), value_hidden=(4,))


@pytest.fixture
def npg() -> lw.NPG:
    return lw.NPG(lw.make("point_mass", nworld=2, horizon=6), config=SMALL)


class Log(lw.Callback):
    """Notes its calls, and raises an error in the call of a given name."""

    def __init__(self, fails: str = "", **settings: Any) -> None:
        self.fails, self.settings, self.calls = fails, settings, list[str]()

    def note(self, name: str) -> None:
        self.calls.append(name)
        if name == self.fails:
            raise KeyError(name)

    def begin(self, run: lw.Run, learner: lw.Learner, iterations: int) -> None:
        assert run.folder.is_dir()
        self.note(f"begin {learner.iteration} of {iterations}")

    def __call__(self, iteration: lw.Iteration) -> bool:
        self.note(str(iteration.iteration))
        return iteration.iteration == 2

    def end(self, run: lw.Run, learner: lw.Learner) -> None:
        self.note(f"end {learner.iteration}")

    def close(self) -> None:
        self.note("close")


def test_callback_is_told_of_the_beginning_and_the_end_of_training(npg: lw.NPG, tmp_path: Path) -> None:
    log, other = Log(note="mine"), Log()
    run = lw.train(npg, tmp_path / "run", 9, callbacks=[log, other], entries={"note": "first", "more": 1})
    assert log.calls == other.calls == ["begin 0 of 9", "1", "2", "end 2", "close"]
    assert (run.config["note"], run.config["more"], run.config["iterations"]) == ("mine", 1, 9)
    log.calls.clear()
    lw.train(npg, run, 3, callbacks=[log, Log(other=2)])
    assert log.calls == ["begin 2 of 3", "3", "end 3", "close"]
    assert (lw.Run.open(run.folder).config["other"], run.config["iterations"]) == (2, 3)


def test_error_in_a_callback_closes_all_callbacks_and_the_run_is_saved(npg: lw.NPG, tmp_path: Path) -> None:
    for fails, calls in (("1", ["1", "close"]), ("end 2", ["1", "2", "end 2", "close"])):
        folder, log, other = tmp_path / fails, Log(fails), Log()
        learner = lw.NPG(npg.env, config=SMALL)
        with pytest.raises(KeyError) as raised:
            lw.train(learner, folder, 9, callbacks=[other, log], save_every=100)
        assert log.calls == ["begin 0 of 9", *calls] and other.calls[-1] == "close"
        assert raised.value.__notes__ == [f"the run in {folder} is saved up to iteration {learner.iteration}"]
        assert lw.Run.open(folder).read()["iteration"] == learner.iteration


def test_training_that_a_callback_refuses_leaves_the_run_as_it_was(npg: lw.NPG, tmp_path: Path) -> None:
    log = Log("begin 0 of 2")
    with pytest.raises(KeyError):
        lw.train(npg, tmp_path / "run", 2, callbacks=[log])
    assert log.calls == ["begin 0 of 2", "close"] and not (tmp_path / "run").exists()
    run = lw.train(npg, tmp_path / "run", 2)
    run.append({"iteration": 3})  # as after kill -9
    before = {path: path.read_bytes() for path in run.folder.iterdir()}
    with pytest.raises(KeyError):
        lw.train(npg, run, 4, callbacks=[Log("begin 2 of 4", note=1)])
    assert {path: path.read_bytes() for path in run.folder.iterdir()} == before


def test_training_ends_at_the_target_return(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The mean policy is evaluated after every second iteration."""
    folder = tmp_path / "run"
    env = lw.make("point_mass", nworld=2)
    run = lw.train(algorithm(env), folder, 9, callbacks=[lw.TargetReturn(-1e6)])
    assert len(run.rows()) == 2 and run.config["target_return"] == -1e6
    resume = ["train", "--resume", str(folder), "--iterations", "4", *QUIET]
    capsys.readouterr()
    assert cli.main(resume) == 2
    refused(capsys, f"the run in {folder} is finished", "in iteration 2", "larger target return")
    assert cli.main([*resume, "--target-return", "inf"]) == 0
    assert len(run.rows()) == 4
    for target in (float("nan"), "3"):
        with pytest.raises(ValueError, match=f"target .*{target}"):
            lw.TargetReturn(target)  # type: ignore[arg-type]


def test_training_ends_after_the_given_minutes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    run = lw.train(algorithm(lw.make("point_mass", nworld=2)), folder, 1000, callbacks=[lw.Minutes(1e-6)])
    assert len(run.rows()) == 1 and run.read()["iteration"] == 1
    assert cli.main(["train", "--resume", str(folder), "--iterations", "1000", "--minutes", "1e-6", *QUIET]) == 0
    assert "stopped after 2 of 1000 iterations: the limit is 1e-06 minutes; continue with" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"minutes .* 0"):
        lw.Minutes(0)


def test_training_ends_before_the_iteration_that_would_exceed_the_minutes(
    npg: lw.NPG, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first iteration takes 30 s, for example to compile kernels, the second 20 s, and all others 10 s."""
    clock = [0.0]
    monkeypatch.setattr("lyceum_warp.training.stopping.time", SimpleNamespace(monotonic=lambda: clock[0]))
    ends = []
    for minutes in (0.01, 75 / 60, 95 / 60):
        clock[0], first = 0.0, npg.iteration

        def pass_time(it: lw.Iteration, first: int = first) -> None:
            clock[0] += {1: 30.0, 2: 20.0}.get(it.iteration - first, 10.0)

        lw.train(npg, tmp_path / f"{minutes}", 100, callbacks=[pass_time, lw.Minutes(minutes)])
        ends.append((npg.iteration - first, clock[0]))
    assert ends == [(1, 30.0), (3, 60.0), (5, 80.0)]


def test_training_in_python_writes_the_same_videos_as_the_command_line(npg: lw.NPG, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no camera 'side'"):
        lw.train(npg, tmp_path / "run", 2, callbacks=[lw.Videos(1, camera="side")])
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match="every .* -1"):
        lw.Videos(-1)
    run = lw.train(npg, tmp_path / "run", 4, callbacks=[lw.Videos(2, camera="free")])
    assert run.config["video_every"] == 2 and len(run.rows()) == 4
    if not (run.folder / "videos").exists():
        pytest.skip("this machine cannot draw")
    assert sorted(path.name for path in (run.folder / "videos").iterdir()) == ["000002.mp4", "000004.mp4"]


def test_training_in_python_continues_if_no_video_can_be_drawn(
    npg: lw.NPG, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(renderer, "backends", lambda: ["nonsense"])
    with caplog.at_level(logging.WARNING):
        run = lw.train(npg, tmp_path / "run", 2, callbacks=[lw.Videos(1)])
    assert len(run.rows()) == 2 and not (run.folder / "videos").exists()
    (message,) = caplog.messages
    assert message.startswith("no further videos (") and "nonsense" in message


def test_run_folder_contains_the_result_of_the_transfer_test(tmp_path: Path) -> None:
    test = lw.TransferTest(warp=False)
    coarse = lw.NPG(lw.make("point_mass", nworld=2, frame_skip=2, horizon=20), config=SMALL)
    run = lw.train(coarse, tmp_path / "coarse", 1, callbacks=[test])
    verdict = json.loads(run.transfer.read_text())
    (pair,) = verdict["comparisons"]
    assert (verdict["iteration"], verdict["episodes"], pair["second"]) == (1, 64, "own physics")
    lengths = pair["differences"][1]
    assert (lengths["first"], lengths["second"], lengths["verdict"]) == (20.0, 20.0, "same")
    assert verdict["line"].startswith(f"own physics against exact physics: {pair['verdict']} (return ")
    assert not lw.train(coarse, tmp_path / "without", 2).transfer.exists()
