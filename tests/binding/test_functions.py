from pathlib import Path

import pytest
import tiny_task

from lyceum_warp.binding import TaskSource, find_task
from lyceum_warp.core import FUNCTIONS

MEANT = {
    name: f"def {function.signature}:\n    {function.default}"
    for name, function in FUNCTIONS.items()
    if name not in ("tally", "share")
}


def source_of(folder: Path, text: str) -> TaskSource:
    return TaskSource(find_task(tiny_task.write(folder, text)))


@pytest.mark.parametrize("name", MEANT)
def test_function_with_the_documented_signature_is_found_and_another_signature_is_refused(
    name: str, tmp_path: Path
) -> None:
    text = tiny_task.TINY if name == "observe" else tiny_task.with_function(MEANT[name])
    assert source_of(tmp_path, text).functions[name] is not None
    with pytest.raises(ValueError) as caught:
        source_of(tmp_path, text.replace(f"def {name}(", f"def {name}(more: float, "))
    more = ", with or without a last argument rng: Row[wp.uint32]" if name == "observe" else ""
    assert str(caught.value) == f"{name} must be written as {FUNCTIONS[name].signature}{more}"


CLASS = "class Tiny(lw.Task):"
MISTAKES = {
    "another result": (
        CLASS, f"@wp.func\ndef terminated(s: World, p: Params) -> float:\n    return 1.0\n\n{CLASS}",
        r"terminated must be written as terminated\(s: World, p: Params\) -> bool",
    ),
    "no observe": ("def observe", "def look", r"there is no observe\(s, p, obs\)"),
    "an ordinary class World": (
        CLASS, f"{CLASS}\n    class World:\n        qpos: Row[float]\n",
        "World must be a @wp.struct in the task's module, not <class",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_struct_function_or_attribute_raises_an_error(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        source_of(tmp_path, tiny_task.changed((old, new)))


def test_annotations_may_be_text(tmp_path: Path) -> None:
    text = f"from __future__ import annotations\n{tiny_task.TINY}"
    assert source_of(tmp_path, text).functions["observe"] is not None


def test_observation_group_may_be_written_by_a_function_after_the_class(tmp_path: Path) -> None:
    text = tiny_task.changed(('obs = {"x": 1}', 'obs = {"policy": {"x": 1}, "critic": {"y": 1}}'))
    after = "@wp.func\ndef observe_critic(s: World, p: Params, obs: Row[float]):\n    obs[0] = s.qpos[1]\n"
    assert list(source_of(tmp_path, f"{text}\n\n{after}").observers) == ["policy", "critic"]
