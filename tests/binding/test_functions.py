from pathlib import Path

import pytest
import tiny_task

from lyceum_warp.binding import TaskSource, find_task, task_name
from lyceum_warp.core import FUNCTIONS

MEANT = {
    name: f"def {function.signature}:\n    {function.default}"
    for name, function in FUNCTIONS.items()
    if name not in ("tally", "share")
}


def source_of(folder: Path, text: str) -> TaskSource:
    task = find_task(tiny_task.write(folder, text))
    return TaskSource(task, task_name(task))


@pytest.mark.parametrize("name", MEANT)
def test_function_with_the_documented_signature_is_found_and_another_signature_is_refused(
    name: str, tmp_path: Path
) -> None:
    text = tiny_task.TINY if name == "observe" else tiny_task.with_function(MEANT[name])
    assert source_of(tmp_path, text).functions[name] is not None
    with pytest.raises(ValueError) as caught:
        source_of(tmp_path, text.replace(f"def {name}(", f"def {name}(more: float, "))
    more = ", with or without a last argument rng: Row[wp.uint32]" if name == "observe" else ""
    assert str(caught.value) == f"{name} of the task 'tiny' must be written as {FUNCTIONS[name].signature}{more}"


CLASS = "class Tiny(lw.Task):"
MISTAKES = {
    "another result": (
        CLASS, f"@wp.func\ndef terminated(s: World, p: Params) -> float:\n    return 1.0\n\n{CLASS}",
        r"terminated of the task 'tiny' must be written as terminated\(s: World, p: Params\) -> bool",
    ),
    "no observe": ("def observe", "def look", r"the task 'tiny' has no observe\(s, p, obs\)"),
    "annotations as text": (
        "obs: Row[float]):", "obs: 'Row[float]'):", "observe of the task 'tiny' has annotations that are text"
    ),
    "an ordinary class World": (
        CLASS, f"{CLASS}\n    class World:\n        qpos: Row[float]\n",
        "World of the task 'tiny' must be a Warp struct: decorate it with @wp.struct",
    ),
    "a misspelt attribute": (CLASS, f"{CLASS}\n    horzon = 10", "'horzon' in its class: did you mean horizon"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_struct_function_or_attribute_raises_an_error(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        source_of(tmp_path, tiny_task.changed((old, new)))


CRITIC = "@wp.func\ndef observe_critic(s: World, p: Params, obs: Row[float]):\n    obs[0] = s.qpos[0]\n\n"
OBSERVE = "def observe(s: World, p: Params, obs: Row[float]):\n"
USERS = {
    "a class that lists the group": "\nclass Other(lw.Task):\n    obs = {'policy': {'x': 1}, 'critic': {'x': 1}}\n",
    "a class that may list it": "\nclass Other(lw.Task):\n    obs = staticmethod(lambda p: {'x': 1})\n",
    "a class that has it as observe": "\nclass Other(lw.Task):\n    observe = observe_critic\n",
    "a function that calls it": f"\n@wp.func\n{OBSERVE.replace('observe', 'all')}    observe_critic(s, p, obs)\n",
    "none": "",
}


@pytest.mark.parametrize("user", USERS)
def test_unused_observe_function_without_a_group_raises_an_error(user: str, tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, tiny_task.changed(("class Tiny", f"{CRITIC}class Tiny")) + USERS[user])
    task = find_task(f"{file}:Tiny")
    source = TaskSource(task, task_name(task))
    if user == "none":
        with pytest.raises(ValueError, match="no group 'critic', which observe_critic writes"):
            source.group_functions(["policy"])
    else:
        assert list(source.group_functions(["policy"])) == ["policy"]
    assert list(source.group_functions(["policy", "critic"])) == ["policy", "critic"]
