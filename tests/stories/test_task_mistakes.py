from pathlib import Path

import pytest
import tiny_task
import torch
from conftest import TaskFile
from tiny_task import attribute, field, function

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
MASS = field("body_mass: Row[float]")
RNG = "rng: Row[wp.uint32]"
STEP = "s0: World, action: Row[float], s1: World, p: Params"
MISTAKES: dict[str, tuple[list[tuple[str, str]], str]] = {
    # the file
    "missing import": (
        [("import warp as wp", "import warp as wp\nimport not_installed.sub")],
        r"file .*tiny\.py, line 3: No module named 'not_installed': install the missing module, or put it into",
    ),
    "syntax": (
        [("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0")],
        r"file .*tiny\.py, line \d+: SyntaxError: '\[' was never closed",
    ),
    "a class without lw.Task": (
        [("class Tiny(lw.Task)", "@lw.register\nclass Tiny")],
        r"line \d+: @lw\.register takes a subclass of lw\.Task, not Tiny: write class Tiny\(lw\.Task\)",
    ),
    # structs
    "World without wp.struct": (
        [("@wp.struct\nclass World", "class World")],
        r"the argument s of observe has the type World, which must be decorated with @wp\.struct",
    ),
    "Params without wp.struct": (
        [("@wp.struct\nclass Params", "class Params")],
        r"the argument p of observe has the type Params, which must be decorated with @wp\.struct",
    ),
    "text in Params": (
        [("    dt: float", "    dt: float\n    name: str")],
        r"line \d+: a @wp\.struct has a field of the type str: it can hold float, int, bool, vectors and matrices",
    ),
    "an ordinary class World": (
        [("class Tiny(lw.Task):", "class Tiny(lw.Task):\n    class World:\n        qpos: Row[float]\n")],
        "World must be a @wp.struct in the task's module, not <class",
    ),
    "a row of another type": (
        [field("xpos: Row[float]")], r"World.xpos must be declared as Row\[wp.vec3\]",
    ),
    "a row for a number": ([field("time: Row[float]")], "World.time must be declared as float"),
    # functions
    "no observe": ([("def observe", "def look")], r"there is no observe\(s, p, obs\)"),
    "another result": (
        [function("def terminated(s: World, p: Params) -> float:\n    return 1.0")],
        r"terminated must be written as terminated\(s: World, p: Params\) -> bool",
    ),
    "an observation of NaN": (
        [("obs[0] = s.qpos[0]", "obs[0] = wp.sqrt(s.qpos[0] - 100.0)")], "observe writes not-a-number into x of obs",
    ),
    "a field that World lacks": (
        [function(f"{REWARD} -> float:\n    return s1.qvel[0]")],
        r"reward \(tiny\.py, line 20\).*: add qvel: Row\[float\] to World",
    ),
    "Warp's function for a quaternion": (
        [function(f"{REWARD} -> float:\n    return wp.quat_rotate(lw.quat(1.0, 0.0, 0.0, 0.0), wp.vec3())[0]")],
        "quat_rotate.*: quaternions are w, x, y, z here: use lw.quat_rotate",
    ),
    "a product of quaternions": (
        [function(f"{REWARD} -> float:\n    q = lw.quat(1.0, 0.0, 0.0, 0.0)\n    return (q * q)[0]")],
        "quaternions are w, x, y, z here: use lw.quat_rotate, lw.quat_mul",
    ),
    "an assignment to an element": (
        [function(f"def randomize(s: World, p: Params, {RNG}):\n    s.qpos[0] *= 2.0")],
        r"write a\[i\] = a\[i\] \* x in place of a\[i\] \*= x",
    ),
    "a reward that is a tuple": (
        [function(f"{REWARD}:\n    r = (1.0, 2.0)\n    return r")],
        r"returns tuple\w*(\(.*\))?: it must be written as reward|: a function returns one number, not a tuple",
    ),
    "a variable of two types in a helper": (
        [function("def height(s: World):\n    h = s.qpos[0]\n    for i in range(2):\n        h = 1\n    return h\n\n"
                  f"@wp.func\n{REWARD} -> float:\n    return height(s1)")],
        r"can't compile height \(tiny\.py, line 22\): 'h = 1'",
    ),
    "observe without wp.func": ([("@wp.func\n", "")], r"observe must be a @wp\.func, not <function"),
    "a reward without return": (
        [function(f"{REWARD} -> float:\n    wp.abs(action[0])")],
        f"reward has no return: write it as {WRITE_REWARD}",
    ),
    "a function of another file": (
        [(OWN_WORLD, "from other_rewards import World, reward\n")],
        r"reward takes Params from .*other_rewards\.py, but the task uses Params from .*tiny\.py"
        r": import World and Params from the same file, write the task's struct as class Params\(other_rewards\.",
    ),
    "a function of another file with its own structs": (
        [("class Tiny", "from other_rewards import reward\n\nclass Tiny")],
        r"reward takes World from .*other_rewards\.py, but the task uses World from .*tiny\.py",
    ),
    # attributes, fields and writes
    "a name like no field": ([field("wheels: Row[float]")], "there is no field 'wheels': .*MuJoCo's names"),
    "a negative mass": (
        [MASS, function(f"def randomize(s: World, p: Params, {RNG}):\n    s.body_mass[1] = s.body_mass[1] - 9.0")],
        r"'tiny': body_mass\[1\] of world 0 is -\S+ and must be positive \(its nominal value is 3\S*\)",
    ),
    "drawn twice": (
        [MASS, function(f"def startup(s: World, p: Params, {RNG}):\n    s.body_mass[1] = 2.0"),
         function(f"def randomize(s: World, p: Params, {RNG}):\n    s.body_mass[2] = 2.0")],
        "the model field 'body_mass' is written by startup and by resets or events",
    ),
    "a group that no function fills": (
        [('obs = {"x": 1}', 'obs = {"policy": {"x": 1}, "critic": {"x": 1}}')],
        r"observe_critic\(s: World, p: Params, obs: Row\[float\]\)",
    ),
    "a group of two words": (
        [('obs = {"x": 1}', 'obs = {"policy": {"x": 1}, "my group": {"x": 1}}')],
        "obs has the group 'my group': a group's name must be a Python name, such as 'critic'",
    ),
    "groups without a policy": (
        [('obs = {"x": 1}', 'obs = {"actor": {"x": 1}, "critic": {"x": 1}}')],
        "must be a dict of parts and sizes, or a dict of such dicts for groups, including 'policy'",
    ),
    "metrics as a number": ([attribute("metrics = 5")], r"metrics must be names, .*, not 5"),
    "a comma in a metric's name": (
        [attribute('metrics = ("a,b",)'), function(f"def measure({STEP}, metrics: Row[float]):\n    metrics[0] = 1.0")],
        "the metric 'a,b': .* no comma, quote or line break",
    ),
    "a keyframe that is not there": ([attribute('keyframe = "home"')], "'home'"),
    "actions without control": ([attribute('actions = {"speed": 1}')], "actions of its own needs control"),
    "actions without sizes": (
        [attribute('actions = ("speed",)')], r"must be a dict of names and sizes, such as \{'speed': 1\}",
    ),
    "memory of no numbers": (
        [field("level: Row[wp.uint32] = lw.memory()")], r"World\.level has a size, .*: .* as level: Row\[float\]",
    ),
    "memory with the name of a field": (
        [field("qvel: Row[float] = lw.memory()")], r"memory World\.qvel has the name of an existing",
    ),
    "memory with the name of a counter": ([field("step: Row[float] = lw.memory()")], r"World\.step has the name of"),
    "memory of size 0": ([field("level: Row[float] = lw.memory(0)")], r"size of World\.level must be a whole number"),
    "memory with the size of no table": (
        [field('level: Row[float] = lw.memory("dt")')], r"size of World\.level is 'dt', which is not a table in Params",
    ),
    "a reward that writes": (
        [function(f"def reward({STEP}) -> float:\n    s1.qpos[0] = 1.0\n    return 0.0")],
        r"reward writes s1\.qpos \(.*tiny\.py, line 20\): ",
    ),
    "advance that writes an input": (
        [field("xfrc_applied: Row[wp.spatial_vector]"),
         function(f"def advance({STEP}, {RNG}):\n    s1.xfrc_applied[1] = wp.spatial_vector()")],
        r"advance writes s1\.xfrc_applied \(.*tiny\.py, line 21\): .* is written by control",
    ),
    "control that writes the state": (
        [function("def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):\n    s.qpos[0] = 0.0")],
        r"control writes s\.qpos \(.*tiny\.py, line \d+\): .* is written by initialize or randomize",
    ),
    "a substep that writes the model": (
        [MASS, function("def substep(s: World, p: Params):\n    s.body_mass[1] = 2.0")],
        r"substep writes s\.body_mass \(.*tiny\.py, line \d+\): .* is written by startup",
    ),
    "observe that writes": (
        [("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0]\n    s.qpos[0] = 0.0")],
        r"observe writes s\.qpos \(.*tiny\.py, line \d+\): observe may write obs",
    ),
    "a function that writes a table": (
        [("    dt: float", "    dt: float\n    table: wp.array[float] = [1.0]"),
         function("def initialize(s: World, p: Params):\n    p.table[0] = 2.0")],
        r"writes p\.table \(.*\): parameters are changed with env\.set_params",
    ),
    "a native function that may write": (
        [("@wp.func", '@wp.func_native("row[0] = 1.0f;")\ndef poke(row: Row[float]): ...\n\n\n@wp.func'),
         ("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0]\n    poke(s.qpos)")],
        r"observe uses s\.qpos as a whole in 'poke\(s\.qpos\)' \(.*\), and may write it there",
    ),
    "a quotient of integers in a helper": (
        [("class Tiny", "@wp.func\ndef part(row: Row[float], n: int) -> float:\n    return float(n / row.shape[0])\n\n"
          f"@wp.func\n{REWARD} -> float:\n    return part(action, 1)\n\nclass Tiny")],
        r"part \(tiny\.py, line 20\): 'return float\(n / row\.shape\[0\]\)': .* n // 2",
    ),
    "a term with a quotient of integers": (
        [attribute('rewards = {"half": 1.0}'), function("def half(s: World) -> float:\n    return float(1 / 2)")],
        r"half \(tiny\.py, line \d+\): 'return float\(1 / 2\)': .* write 1\.0 / 2\.0",
    ),
    "randomize that reads a derived field in a helper": (
        [field("xpos: Row[wp.vec3]"), function(f"def drop(s: World):\n    s.qpos[1] = -s.xpos[1][2]\n\n"
         f"@wp.func\ndef randomize(s: World, p: Params, {RNG}):\n    drop(s)")],
        r"randomize reads xpos in drop \(tiny\.py, line 21\), but MuJoCo computes xpos after",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistake_in_a_task_file_raises_a_one_line_error(
    changes: list[tuple[str, str]], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny_task.write(tmp_path, OTHER_FILE, "other_rewards.py")
    monkeypatch.syspath_prepend(tmp_path)
    tiny_task.check_mistake(tmp_path, changes, message)


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
