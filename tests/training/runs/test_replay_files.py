import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.training import Run
from lyceum_warp.training.runs import replay_files, saving


def made(replay: int = 80) -> lw.SAC:
    """Make a learner with 12 steps per iteration. By default, its buffer holds 20 steps."""
    config = lw.SACConfig(
        hidden=(8,), value_hidden=(8,), num_steps=12, warmup=40, batch=16, updates=1, replay=replay, mean_every=0
    )
    return lw.SAC(lw.make(Metered, nworld=4, horizon=10, far=0.3), config=config)


def numbers(folder: Path) -> list[dict[str, Any]]:
    rows = Run.open(folder).rows()
    return [{k: v for k, v in row.items() if "time" not in k and k != "samples_per_second"} for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("whole") / "run"
    lw.train(made(), folder, 5)
    return numbers(folder)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("owner, name, calls", [
    (replay_files, "write_content", 0), (replay_files, "write_content", 7), (Run, "save", 0),
    (saving, "clean_replay", 0),
])  # fmt: skip
def test_run_continues_identically_after_a_save_was_killed_at_any_point(
    owner: Any, name: str, calls: int, whole: list[dict[str, Any]], tmp_path: Path
) -> None:
    sac, function = made(), getattr(owner, name)
    left = [calls]

    def killed(*args: Any, **words: Any) -> Any:
        if sac.iteration == 3:
            if not left[0]:
                raise Killed
            left[0] -= 1
        return function(*args, **words)

    with pytest.raises(Killed), pytest.MonkeyPatch.context() as patched:
        patched.setattr(owner, name, killed)
        lw.train(sac, tmp_path / "run", 5, save_every=1)
    lw.train(made(), Run.open(tmp_path / "run"), 5, save_every=1)
    np.testing.assert_equal(numbers(tmp_path / "run"), whole)
    assert len(list((tmp_path / "run" / "replay").iterdir())) == 20


def test_an_interrupted_run_continues_identically(whole: list[dict[str, Any]], tmp_path: Path) -> None:
    def interrupting(iteration: lw.Iteration) -> None:
        if iteration.iteration == 3:
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # child processes of a shell may ignore SIGINT
    try:
        with pytest.raises(KeyboardInterrupt):
            lw.train(made(), tmp_path / "run", 5, callbacks=[interrupting])
    finally:
        signal.signal(signal.SIGINT, before)
    assert Run.open(tmp_path / "run").read()["iteration"] == 3
    lw.train(made(), Run.open(tmp_path / "run"), 5)
    np.testing.assert_equal(numbers(tmp_path / "run"), whole)


def test_save_writes_only_files_of_the_buffer_that_have_grown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    written: list[str] = []
    write: Callable[..., None] = replay_files.write_content

    def noted(path: Path, *args: Any, **words: Any) -> None:
        written.append(path.stem.lstrip("0-"))
        write(path, *args, **words)

    monkeypatch.setattr(replay_files, "write_content", noted)
    folder = tmp_path / "run"
    lw.train(made(replay=800), folder, 2, save_every=1)
    ends = [int(name.rpartition("-")[2]) for name in written]
    assert ends == [4, 8, 12, 16, 20, 24]
    (folder / "checkpoint.pt").write_bytes(b"")  # after a power loss, only previous.pt remains
    lw.train(made(replay=800), Run.open(folder), 3, save_every=1)
    assert "previous.pt, of iteration 1, is used instead" in caplog.text
    lw.train(made(replay=800), tmp_path / "other", 3)
    np.testing.assert_equal(numbers(folder), numbers(tmp_path / "other"))
