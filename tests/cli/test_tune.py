import dataclasses
from pathlib import Path

import pytest
from training_runs import refused

from lyceum_warp import cli
from lyceum_warp.tuning import judgement, search
from lyceum_warp.tuning.trial import SHORT

QUICK = ["--short", "--episodes", "8", "--nworld", "8", "--nthread", "1", "--tolerance", "any"]


def test_tune_prints_a_table_and_flags_for_other_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "SHORT", dataclasses.replace(SHORT, repeats=2, block_seconds=0.005, steps=40))
    monkeypatch.setattr(judgement, "LEAST_GAIN", 0.0)  # measured speeds are random on a busy machine
    assert cli.main(["tune", "half_cheetah", *QUICK, "--out", str(tmp_path / "rows.jsonl")]) == 0
    out, err = capsys.readouterr()
    assert "half_cheetah: 8 worlds, mujoco engine on" in out and "the task as it is" in out
    assert "1 x 50 ms" in out and "1 x 50 ms: " in err
    assert "\nnext:       lyceum-warp train half_cheetah" in out
    flags = next(line for line in out.splitlines() if line.startswith("flags: ")).removeprefix("flags: ").split()
    assert cli.main(["check", "half_cheetah", "--rule", "reset", *flags]) == 0


@pytest.mark.parametrize(("options", "words"), [
    (["hoper"], ["'hoper'"]),
    (["hopper", "--tolerance", "tight"], ["tolerance", "'tight'"]),
    (["hopper", "--run", "none"], ["none"]),
])  # fmt: skip
def test_invalid_tune_arguments_print_one_line(
    options: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["tune", *options]) == 2
    refused(capsys, *words)
