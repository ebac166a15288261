"""Generate the text of a task file for a model, for lyceum-warp new."""

import json
import textwrap
from collections.abc import Sequence

import mujoco
import numpy as np

_STEP = 0.02
"""Desired duration of a step, in seconds."""

_EPISODE = 10.0
"""Duration of an episode, in seconds."""

_WIDTH = 116
"""Width of a list of names in a comment, in characters."""

_ELEMENTS = {
    "bodies": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "joints": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "sites": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "sensors": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "actuators": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nactuator"),
    "keyframes": (mujoco.mjtObj.mjOBJ_KEY, "nkey"),
}

_Sensor = mujoco.mjtSensor

_UNOBSERVED = (_Sensor.mjSENS_USER, _Sensor.mjSENS_PLUGIN, _Sensor.mjSENS_CLOCK)
"""Types of sensors that do not measure the robot's state, or that need custom code."""


def task_text(file: str, class_name: str, source: str, model: mujoco.MjModel) -> str:
    """Generate the text of a task file, in ruff's format.

    ``source`` is the model as a Python expression, such as ``"robot.xml"`` with its quotes.
    """
    fields, parts, put = _observation(model)
    sizes = ", ".join(f'"{name}": {size}' for name, size in parts.items())
    settings = [f"model = {source}", *_lengths(model), f"obs = {{{sizes}}}"]
    if _has_other_ranges(model):
        settings.append("action_range = (-1.0, 1.0)  # scaled to the controls' ranges; without it: the controls")
    if "home" in _names(model, "keyframes"):
        settings.append('keyframe = "home"  # where episodes start')
    return _TEXT.format(
        file=file, class_name=class_name, elements=_elements(model), fields=indented(fields),
        put=indented(put), settings=indented(settings),
    )  # fmt: skip


def _lengths(model: mujoco.MjModel) -> list[str]:
    substep = model.opt.timestep
    frame_skip = max(1, round(_STEP / substep))
    horizon = max(1, round(_EPISODE / (frame_skip * substep)))
    return [
        f"frame_skip = {frame_skip}  # substeps of {1000 * substep:g} ms in a step",
        f"horizon = {horizon}  # steps in an episode, {horizon * frame_skip * substep:.3g} s; 0 for no limit",
    ]


def _has_other_ranges(model: mujoco.MjModel) -> bool:
    """Return True if every control has a range and some range differs from -1 to 1."""
    limited, ranges = model.actuator_ctrllimited.astype(bool), model.actuator_ctrlrange
    return bool(limited.all() and (ranges[:, 0] < ranges[:, 1]).all() and (ranges != (-1.0, 1.0)).any())


def _observation(model: mujoco.MjModel) -> tuple[list[str], dict[str, int], list[str]]:
    """Generate the fields of World, the sizes of the observation's parts, and the lines that write the observation."""
    fields, rows = ["qpos: Row[float]", "qvel: Row[float]"], ["s.qpos", "s.qvel"]
    parts = {"position": model.nq, "velocity": model.nv}
    if model.na:
        fields.append("act: Row[float]")
        parts["activation"] = model.na
        rows.append("s.act")
    if sensed := _sensor_places(model):
        fields.append("sensordata: Row[float]")
        parts["sensors"] = sum(last - first for first, last in sensed)
        whole = sensed == [(0, model.nsensordata)]
        rows += ["s.sensordata"] if whole else [f"s.sensordata, {first}, {last}" for first, last in sensed]
    put = [f"k = lw.put(obs, {'k' if i else 0}, {row})" for i, row in enumerate(rows)]
    put[-1] = put[-1].removeprefix("k = ")
    return fields, parts, put


def _sensor_places(model: mujoco.MjModel) -> list[tuple[int, int]]:
    places: list[tuple[int, int]] = []
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return places
    for kind, start, size in np.stack([model.sensor_type, model.sensor_adr, model.sensor_dim], axis=1).tolist():
        if kind in _UNOBSERVED or not size:
            continue
        if places and places[-1][1] == start:
            places[-1] = places[-1][0], start + size
        else:
            places.append((start, start + size))
    return places


def _elements(model: mujoco.MjModel) -> str:
    names = {kind: [name for name in _names(model, kind) if name.isprintable() and name] for kind in _ELEMENTS}
    names["bodies"] = [name for name in names["bodies"] if name != "world"]
    mocap = {name for i, name in enumerate(_names(model, "bodies")) if model.body_mocapid[i] >= 0}
    names["mocap bodies"] = [name for name in names["bodies"] if name in mocap]
    lines = [
        textwrap.shorten(f"{kind}: {', '.join(found)}", _WIDTH, placeholder=" ...")
        for kind, found in names.items()
        if found
    ]
    if not lines:
        return ""
    element, field = ("site", "site_xpos") if names["sites"] else ("body", "xpos")
    name = next(iter(names["sites"] or names["bodies"]), "tip")
    example = f"tip: int = lw.{element}({literal(name)})"
    comment = [
        "Names in the model. A default in Params turns one into an index, as in",
        f"    {example}",
        f"with {field} in World, s.{field}[p.tip] is then a position; lw.joint, lw.sensor, ... find other kinds",
        *(f"  {line}" for line in lines),
    ]
    return "".join(f"# {line}\n" for line in comment) + "\n\n"


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    objtype, count = _ELEMENTS[kind]
    return [mujoco.mj_id2name(model, objtype, i) or "" for i in range(getattr(model, count))]


def indented(lines: Sequence[str], indent: int = 4) -> str:
    """Indent lines and join them."""
    return "\n".join(f"{' ' * indent}{line}" for line in lines)


def literal(text: str) -> str:
    """Write a string as a Python literal in double quotes."""
    return json.dumps(text, ensure_ascii=False)


_TEXT = '''"""{class_name}: a task whose reward is still to be written.

``lyceum-warp check {file}`` checks this task, and ``lyceum-warp train {file}`` trains it.
``help(lw.Task)`` describes every function of a task.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

{elements}@wp.struct
class World:  # the fields that the functions read, by MuJoCo's names: add xpos, site_xpos, cvel, ctrl, ... as needed
{fields}


@wp.struct
class Params:  # parameters that users can set, as in --param reset_noise=0.1
    dt: float  # filled in: seconds in a step
    reset_noise: float = 0.01


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
{put}


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    # reward of the step from s0 to s1, for example: return s1.qvel[0] - 0.001 * lw.sum_squares(action)
    return 0.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(s.qvel.shape[0]):
        s.qvel[i] += lw.uniform(rng, -p.reset_noise, p.reset_noise)


# Three more functions that most tasks have:
#
# @wp.func
# def evaluate(s: World, p: Params) -> float:
#     return s.qpos[0]  # a metric in physical units, separate from the reward
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
