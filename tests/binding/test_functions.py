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


def test_annotations_may_be_text(tmp_path: Path) -> None:
    text = f"from __future__ import annotations\n{tiny_task.TINY}"
    assert source_of(tmp_path, text).functions["observe"] is not None


def test_observation_group_may_be_written_by_a_function_after_the_class(tmp_path: Path) -> None:
    text = tiny_task.changed(('obs = {"x": 1}', 'obs = {"policy": {"x": 1}, "critic": {"y": 1}}'))
    after = "@wp.func\ndef observe_critic(s: World, p: Params, obs: Row[float]):\n    obs[0] = s.qpos[1]\n"
    assert list(source_of(tmp_path, f"{text}\n\n{after}").observers) == ["policy", "critic"]
