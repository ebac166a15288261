"""Write the text of a task file for a model, for lyceum-warp new."""

import json
import textwrap

import mujoco

_STEP = 0.02
"""Seconds in a step, approximately."""

_EPISODE = 10.0
"""Seconds of an episode."""

_WIDTH = 114
"""Columns of a comment that lists names."""

_ELEMENTS = {
    "bodies": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "joints": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "sites": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "sensors": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "actuators": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nactuator"),
    "keyframes": (mujoco.mjtObj.mjOBJ_KEY, "nkey"),
}
"""The kinds of elements whose names a comment lists, with the fields of MjModel that count them."""


def task_text(file: str, class_name: str, source: str, title: str, model: mujoco.MjModel) -> str:
    """The text of a task file, formatted as ruff formats it.

    Args:
        file: The name of the file.
        class_name: The name of the task's class.
        source: The model as an expression in Python, such as ``"robot.xml"`` with its quotes.
        title: The model's name in the docstring.
        model: The compiled model.
    """
    fields, parts, put = _observation(model)
    sizes = ", ".join(f'"{name}": {size}' for name, size in parts.items())
    settings = [f"model = {source}", *_lengths(model), f"obs = {{{sizes}}}"]
    if _has_other_ranges(model):
        settings.append("action_range = (-1.0, 1.0)  # scaled to the controls' ranges; without it: the controls")
    if "home" in _names(model, "keyframes"):
        settings.append('keyframe = "home"  # where episodes start')
    return _TEXT.format(
        file=file, class_name=class_name, title=title, elements=_elements(model), fields=_indented(fields),
        put=_indented(put), settings=_indented(settings),
    )  # fmt: skip


def _lengths(model: mujoco.MjModel) -> list[str]:
    """The lines that set the length of a step and of an episode."""
    substep = model.opt.timestep
    frame_skip = max(1, round(_STEP / substep))
    horizon = max(1, round(_EPISODE / (frame_skip * substep)))
    return [
        f"frame_skip = {frame_skip}  # substeps of {1000 * substep:g} ms in a step",
        f"horizon = {horizon}  # steps in an episode, {horizon * frame_skip * substep:.3g} s; 0 for no limit",
    ]


def _has_other_ranges(model: mujoco.MjModel) -> bool:
    """Whether every control has a range, and not all have -1 to 1."""
    limited, ranges = model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange
    return bool(limited.all() and (ranges[:, 0] < ranges[:, 1]).all() and (ranges != (-1.0, 1.0)).any())


def _observation(model: mujoco.MjModel) -> tuple[list[str], dict[str, int], list[str]]:
    """The fields of World, the parts of the observation with their sizes, and the lines that write it."""
    found = {"position": ("qpos", model.nq), "velocity": ("qvel", model.nv), "activation": ("act", model.na),
             "sensors": ("sensordata", model.nsensordata)}  # fmt: skip
    found = {name: (field, size) for name, (field, size) in found.items() if size}
    fields = [f"{field}: Row[float]" for field, _ in found.values()]
    put = [f"k = lw.put(obs, {'k' if i else '0'}, s.{field})" for i, (field, _) in enumerate(found.values())]
    put[-1] = put[-1].removeprefix("k = ")
    return fields, {name: size for name, (_, size) in found.items()}, put


def _elements(model: mujoco.MjModel) -> str:
    """A comment with the names of the model's elements, and an example of their use."""
    names = {kind: [name for name in _names(model, kind) if name.isprintable() and name] for kind in _ELEMENTS}
    names["bodies"] = [name for name in names["bodies"] if name != "world"]
    mocap = {name for i, name in enumerate(_names(model, "bodies")) if model.body_mocapid[i] >= 0}
    names["mocap bodies"] = [name for name in names["bodies"] if name in mocap]
    lines = [textwrap.shorten(f"{kind}: {', '.join(found)}", _WIDTH, placeholder=" ...")
             for kind, found in names.items() if found]  # fmt: skip
    if not lines:
        return ""
    element, field = ("site", "site_xpos") if names["sites"] else ("body", "xpos")
    name = next(iter(names["sites"] or names["bodies"]), "tip")
    example = f"tip: int = lw.{element}({literal(name)})"
    comment = [
        "Names in the model. A default in Params turns one into an index, as in",
        f"    {example}",
        f"with {field} in World, s.{field}[p.tip] then is a position; lw.joint, lw.sensor, ... find the other kinds",
        *(f"  {line}" for line in lines),
    ]
    return "".join(f"# {line}\n" for line in comment) + "\n\n"


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind; "" for an element without a name."""
    objtype, count = _ELEMENTS[kind]
    return [mujoco.mj_id2name(model, objtype, i) or "" for i in range(getattr(model, count))]


def _indented(lines: list[str]) -> str:
    return "\n".join(f"    {line}" for line in lines)


def literal(text: str) -> str:
    """Format a text as a Python literal in double quotes."""
    return json.dumps(text, ensure_ascii=False)


_TEXT = '''"""{class_name}: {title}, with a reward that is still to be written.

``lyceum-warp check {file}`` checks this task, ``lyceum-warp train {file}`` trains it, and ``help(lw.Task)`` describes
what a task may consist of.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

{elements}@wp.struct
class World:  # the fields that the functions read, by MuJoCo's names: add xpos, site_xpos, cvel, ctrl, ... as needed
{fields}


@wp.struct
class Params:  # what can be changed from outside, as --param reset_noise=0.1
    dt: float  # filled in: seconds in a step
    reset_noise: float = 0.01


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
{put}


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    # of the step from s0 to s1, for example: return s1.qvel[0] - 0.001 * lw.sum_squares(action)
    return 0.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(s.qvel.shape[0]):
        s.qvel[i] += lw.uniform(rng, -p.reset_noise, p.reset_noise)


# Three more functions that most tasks have:
#
# @wp.func
# def evaluate(s: World, p: Params) -> float:
#     return s.qpos[0]  # a metric in physical units, apart from the reward
#
#
# @wp.func
# def terminated(s: World, p: Params) -> bool:
#     return s.qpos[0] < -10.0  # a state that ends the episode, such as a fall
#
#
# @wp.func
# def success(s: World, p: Params) -> bool:
#     return s.qpos[0] > 10.0  # the goal


@lw.register
class {class_name}(lw.Task):
{settings}
'''
