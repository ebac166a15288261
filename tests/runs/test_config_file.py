import json
from pathlib import Path
from typing import Any

import pytest
from training_runs import QUIET, algorithm, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.runs.folder import Run


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"task": 3}, "task must be"),
        ({"kept": []}, r"kept must be of type dict, not \[\]"),
        ({"kept": {"file": 3}}, "file must be of type str, not 3"),
        ({"params": None}, "params must be of type dict"),
        ({"seed": 2**63}, "seed must be a whole number from 0"),
        ({"nworld": True}, "nworld must be a whole number"),
        ({"tensorboard": 1}, "tensorboard must be of type bool"),
        ({"target_return": "1"}, "target_return must be of type"),
        ({"reached": {"iteration": 1, "return": None}}, "return must be of type"),
        ({"algorithm": "mine", "mine": 3}, "mine must be of type dict"),
        ({"versions": []}, "versions must be of type dict"),
        ({"algorithm": "npg", "npg_seed": -1}, "npg_seed must be a whole number"),
    ],
)
def test_error_of_an_entry_with_a_wrong_type_names_the_file(
    entries: dict[str, Any], words: str, tmp_path: Path
) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"format": 1, **entries}))
    with pytest.raises(ValueError, match=rf"{tmp_path}/config\.json is damaged: {words}"):
        Run.open(tmp_path)


@pytest.mark.parametrize("command", ["eval", "resume"])
def test_error_of_an_invalid_setting_names_the_file(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = lw.train(algorithm(lw.make("point_mass", nworld=2)), tmp_path / "run", iterations=1)
    run.amend(engine="x")
    arguments = {"eval": ["eval", str(run.folder)],
                 "resume": ["train", "--resume", str(run.folder), "--iterations", "2", *QUIET]}  # fmt: skip
    assert cli.main(arguments[command]) == 2
    refused(capsys, "'x'", f"with the settings in {run.folder / 'config.json'}")
