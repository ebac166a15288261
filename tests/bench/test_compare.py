import shutil
from pathlib import Path
from typing import Any

import compare
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def copied(folder: Path, changes: dict[str, tuple[str, str]]) -> Path:
    shutil.copytree(ROOT / "lyceum_warp", folder / "lyceum_warp", ignore=shutil.ignore_patterns("__pycache__"))
    for name, (old, new) in changes.items():
        file = folder / "lyceum_warp" / name
        text = file.read_text()
        assert text.count(old) == 1
        file.write_text(text.replace(old, new))
    return folder


QUICK: dict[str, Any] = {"engines": ("mujoco",), "parts": ("env",), "steps": 3}


@pytest.mark.long
def test_changed_reward_and_broken_tasks_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes = {
        "tasks/point_mass.py": ("return 1.0 - distance(s1)", "return 2.0 - distance(s1)"),
        "tasks/cartpole_swingup.py": ("import warp as wp\n", "import os\nos._exit(3)\n"),
        "tasks/cartpole.py": ("import warp as wp\n", "raise RuntimeError('broken on purpose')\n"),
    }
    tasks = ("cartpole_swingup", "cartpole", "point_mass")
    copy = str(copied(tmp_path, changes))
    report = compare.run(compare.Options(str(ROOT), copy, tasks=tasks, ignore=("*/masked_step/*",), **QUICK))
    reported = {each.name.removeprefix("env/"): each.text for each in report.differences}
    places = ("steps", "of_states", "after_getters", "restored_step", "masked_rand_reset", "fault", "rollout")
    assert set(reported) == {
        *(f"point_mass/mujoco/{place}/reward" for place in places), "cartpole/mujoco", "cartpole_swingup/mujoco",
    }  # fmt: skip
    steps = reported["point_mass/mujoco/steps/reward"]
    assert " at step 0, world 0; max |difference| 1; 12 of 12 differ" in steps
    assert reported["point_mass/mujoco/fault/reward"].endswith("2 of 4 differ")
    assert reported["cartpole/mujoco"] == "new failed: RuntimeError: broken on purpose"
    assert reported["cartpole_swingup/mujoco"] == "new failed: the process ended with 3"
    assert "names" in capsys.readouterr().out and report.ignored > 0


def test_name_that_is_neither_folder_nor_revision_raises_an_error() -> None:
    with pytest.raises(ValueError, match="no_such_revision"):
        compare.run(compare.Options("no_such_revision", str(ROOT)))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (np.uint32(0x3F800000), np.uint32(0x3F800001)),  # 1.0 and the next number
        (np.uint32(0x00000000), np.uint32(0x80000000)),  # 0.0 and -0.0
        (np.uint32(0x7FC00000), np.uint32(0x7FC00001)),  # two kinds of NaN
    ],
)
def test_numbers_that_differ_in_one_bit_are_reported(old: np.uint32, new: np.uint32) -> None:
    before, after = np.full((3, 2), old), np.full((3, 2), old)
    after[1, 0] = new
    before, after = before.view(np.float32), after.view(np.float32)
    text = compare.difference("a", before, after, ["step"]).text
    assert "at step 1, index 0" in text and "1 of 6 differ" in text
    assert compare.difference("a", before, before.copy()) is None


def test_shapes_types_and_texts_are_compared() -> None:
    assert compare.difference("a", np.zeros(2), np.zeros(3)).text == "float64 (2,) -> float64 (3,)"
    assert compare.difference("a", np.zeros(2), np.zeros(2, np.float32)).text == "float64 (2,) -> float32 (2,)"
    assert compare.difference("a", np.array("ab"), np.array("abc")).text == "ab -> abc"
    assert compare.difference("a", np.array("ab"), np.array("ab")) is None


def test_names_in_only_one_checkout_are_reported_as_added_or_removed() -> None:
    zero = np.zeros(1)
    changes = compare.differences("u", {"both": zero, "gone": zero}, {"new": zero, "both": zero}, {})
    assert [(each.name, each.text) for each in changes] == [
        ("u/gone", "removed: float64 (1,)"), ("u/new", "added: float64 (1,)"),
    ]  # fmt: skip
