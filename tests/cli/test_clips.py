from pathlib import Path

import numpy as np
import pytest
from motion_files import go1, go1_clip, write_csv, write_npz
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Run
from lyceum_warp.viz.video import NoVideoError

TINY = [
    *"--iterations 1 --horizon 16 --nworld 4 --num-steps 8 --hidden 8 --value-hidden 8".split(),
    *"--mean-every 0 --no-plot --no-video".split(),
]


def test_clips_of_a_run_are_kept_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_npz(tmp_path / "walk.npz", go1(), go1_clip(0)[:80], 50.0)
    write_csv(tmp_path / "side.csv", go1_clip(2)[:40])
    assert cli.main(["train", "go1_tracking", "--clips", "walk.npz", "side.csv", "--out", "run", *TINY]) == 0
    assert "2 clips, 2.88 s: walk, side" in capsys.readouterr().out
    for file in ("walk.npz", "side.csv"):
        (tmp_path / file).rename(tmp_path / f"moved-{file}")
    assert cli.main(["train", "--resume", "run", "--iterations", "2", "--no-plot"]) == 0
    capsys.readouterr()
    assert cli.main(["train", "--resume", "run", "--iterations", "3", "--clips", "moved-walk.npz"]) == 2
    assert "is another table than the given clips, and a run keeps its settings" in capsys.readouterr().err
    assert cli.main(["train", "go1_tracking", "--clips", "--out", "no"]) == 2
    refused(capsys, "name at least one file")
    assert cli.main(["eval", "run", "--clips", "--transfer"]) == 2
    refused(capsys, "omit --transfer")
    np.save("clips.npy", np.zeros(3))  # another table of this name is not the run's
    picture = True
    try:
        assert cli.main(["eval", "run", "--clips", "--video"]) == 0
    except NoVideoError:
        picture = False
    out, log = capsys.readouterr()
    assert "has changed" not in log
    assert "of 2 clips failed on the C engine, exact physics" in out and "coarse physics" in out
    rows = [line.split() for line in out.splitlines() if line.startswith((" walk", " side", " all"))]
    assert [row[:2] for row in rows[:2]] == [["walk", "1.58"], ["side", "1.30"]] and len(rows) == 6
    assert not picture or (tmp_path / "run/clips.png").stat().st_size > 10_000
    assert cli.main(["eval", "run", "--clips", "moved-side.csv", "--physics", "exact"]) == 0
    out = capsys.readouterr().out
    assert " moved-side " in out and out.count("clips failed on") == 1
    env = lw.make("go1_tracking", **{name: str(path) for name, path in tables(Path("run")).items()})
    assert env.task.params["ranges"][:, 1].tolist() == [80, 66]
    assert cli.main(["train", "hopper", "--clips", "moved-walk.npz", "--out", "no"]) == 2
    refused(capsys, "model whose first joint is free")


def tables(run: Path) -> dict[str, Path]:
    return {name: Run.open(run).task_folder / f"tables/{name}.npy" for name in ("clips",)}
