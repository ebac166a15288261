from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from metered_task import Metered
from training_runs import metrics

import lyceum_warp as lw
from lyceum_warp.training import Run
from lyceum_warp.training.runs import replay_files, saving


def made(replay: int = 80) -> lw.SAC:
    """Make a learner with 12 steps per iteration. By default, its buffer holds 20 steps."""
    config = lw.SACConfig(
        hidden=(8,), value_hidden=(8,), num_steps=12, warmup=40, batch=16, updates=1, replay=replay, mean_every=0
    )
    return lw.SAC(lw.make(Metered, nworld=4, horizon=10, far=0.3), config=config)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    folder = tmp_path_factory.mktemp("whole") / "run"
    lw.train(made(), folder, 5)
    return metrics(folder)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("owner, name, calls", [
    (replay_files, "write_content", 0), (replay_files, "write_content", 7), (Run, "save", 0),
    (saving, "clean_replay", 0),
])  # fmt: skip
def test_run_continues_identically_after_a_save_was_killed_at_any_point(
    owner: Any, name: str, calls: int, whole: list[dict[str, str]], tmp_path: Path
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
    np.testing.assert_equal(metrics(tmp_path / "run"), whole)
    assert len(list((tmp_path / "run" / "replay").iterdir())) == 20


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
    np.testing.assert_equal(metrics(folder), metrics(tmp_path / "other"))
