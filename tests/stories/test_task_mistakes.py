from pathlib import Path

import pytest
import tiny_task
import torch
from conftest import TaskFile

import lyceum_warp as lw

REWARD = "def reward(s0: World, action: Row[float], s1: World, p: Params)"
WRITE_REWARD = r"reward\(s0: World, action: Row\[float\], s1: World, p: Params\) -> float"
OTHER_FILE = f"""
import warp as wp
from lyceum_warp import Row

@wp.struct
class World:
    qpos: Row[float]

@wp.struct
class Params:
    dt: float
    scale: float = 1.0

@wp.func
{REWARD} -> float:
    return p.scale
"""
OWN_WORLD = "@wp.struct\nclass World:\n    qpos: Row[float]\n"


def function(text: str) -> tuple[str, str]:
    return "class Tiny", f"@wp.func\n{text}\n\nclass Tiny"


MISTAKES: dict[str, tuple[tuple[str, str], str]] = {
    # the file
    "missing import": (
        ("import warp as wp", "import warp as wp\nimport not_installed.sub"),
        r"task file .*tiny\.py, line 3: No module named 'not_installed': install the missing module, or put it into",
    ),
    "syntax": (
        ("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0"),
        r"task file .*tiny\.py, line \d+: SyntaxError: '\[' was never closed",
    ),
    "a class without lw.Task": (
        ("class Tiny(lw.Task)", "@lw.register\nclass Tiny"),
        r"line \d+: @lw\.register takes a subclass of lw\.Task, not Tiny: write class Tiny\(lw\.Task\)",
    ),
    # structs
    "World without wp.struct": (
        ("@wp.struct\nclass World", "class World"),
        r"the argument s of observe has the type World, which must be decorated with @wp\.struct",
    ),
    "Params without wp.struct": (
        ("@wp.struct\nclass Params", "class Params"),
        r"the argument p of observe has the type Params, which must be decorated with @wp\.struct",
    ),
    "text in Params": (
        ("    dt: float", "    dt: float\n    name: str"),
        r"line \d+: a @wp\.struct has a field of the type str: it can hold float, int, bool, vectors and matrices",
    ),
    # functions
    "observe without wp.func": (("@wp.func\n", ""), r"observe of the task 'tiny' must be a @wp\.func, not <function"),
    "a reward without return": (
        function(f"{REWARD} -> float:\n    wp.abs(action[0])"),
        f"reward of the task 'tiny' has no return: write it as {WRITE_REWARD}",
    ),
    "a function of another file": (
        (OWN_WORLD, "from other_rewards import World, reward\n"),
        r"reward of the task 'tiny' takes Params from .*other_rewards\.py, but the task uses Params from .*tiny\.py"
        r": import World and Params from the same file, derive the task's struct from the other \(class Params\(",
    ),
    "a function of another file with its own structs": (
        ("class Tiny", "from other_rewards import reward\n\nclass Tiny"),
        r"reward of the task 'tiny' takes World from .*other_rewards\.py, but the task uses World from .*tiny\.py",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistake_in_a_task_file_raises_a_one_line_error(
    change: tuple[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny_task.write(tmp_path, OTHER_FILE, "other_rewards.py")
    monkeypatch.syspath_prepend(tmp_path)
    file = tiny_task.write(tmp_path, tiny_task.changed(change))
    with pytest.raises((ValueError, ImportError, FileNotFoundError), match=message) as caught:
        lw.make(file)
    assert "\n" not in str(caught.value)


def test_corrected_task_file_is_reloaded_and_old_environments_keep_their_task(task_file: TaskFile) -> None:
    name, line = "fixed_later.py", "obs[0] = s.qpos[0]"
    old = lw.make(task_file(name, tiny_task.TINY))
    broken = task_file(name, tiny_task.changed((line, "obs[0] = 2.0 * s.qpos[0")))
    with pytest.raises(ValueError, match="SyntaxError"):
        lw.make(broken)
    new = lw.make(task_file(name, tiny_task.changed((line, "obs[0] = 2.0 * s.qpos[0] + 1.0"))))
    for env in (old, old.replicate(), new):
        env.reset()
        env.step()
        x = env.field("qpos")[:, :1]
        assert torch.equal(env.obs, 2.0 * x + 1.0 if env is new else x)


def test_error_of_a_replaced_buffer_explains_how_to_write_into_it() -> None:
    env = lw.make("hopper", nworld=2)
    with pytest.raises(
        AttributeError, match=r"env\.action is a buffer at a fixed address: write into the buffer, as env\.action"
    ):
        env.action = torch.zeros(2, 3)
    env.step(torch.zeros(2, 3, requires_grad=True) + 1.0)
    assert not env.action.requires_grad
