"""Fill the templates of task files in ruff's format, for lyceum-warp new."""

import json
import string
import textwrap
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from lyceum_warp.models import Legs

TRAINING = "--algorithm ppo --device cuda --iterations 800"
"""Options of lyceum-warp train that suffice to learn walking on one GPU."""

_STEP = 0.02
"""Desired duration of a step, in seconds."""

_EPISODE = 10.0
"""Duration of an episode, in seconds."""

_WIDTH = 116
"""Width of a list of names in a comment, in characters."""

_Sensor = mujoco.mjtSensor

_UNOBSERVED = (_Sensor.mjSENS_USER, _Sensor.mjSENS_PLUGIN, _Sensor.mjSENS_CLOCK)
"""Types of sensors that do not measure the robot's state, or that need custom code."""


def substeps(model: mujoco.MjModel) -> int:
    """Return the number of substeps in a step of the task."""
    return max(1, round(_STEP / model.opt.timestep))


def literal(text: str) -> str:
    """Write a string as a Python literal in double quotes."""
    return json.dumps(text, ensure_ascii=False)


def plain_text(model: mujoco.MjModel, **names: str) -> str:
    """Write a task file whose reward is zero. The arguments are those of ``velocity_text``."""
    elements = _elements(model)
    kind, field = ("site", "site_xpos") if "sites" in elements else ("body", "xpos")
    example = next(iter(elements.get("sites") or elements.get("bodies", ["tip"])))
    lists = [textwrap.shorten(f"{kind}: {', '.join(elements[kind])}", _WIDTH, placeholder=" ...") for kind in elements]
    fields = ["qpos: Row[float]", "qvel: Row[float]"]
    rows = ["s.qpos", "s.qvel"]
    parts = {"position": model.nq, "velocity": model.nv}
    if model.na:
        fields.append("act: Row[float]")
        rows.append("s.act")
        parts["activation"] = model.na
    if ranges := _sensor_ranges(model):
        fields.append("sensordata: Row[float]")
        is_complete = ranges == [[0, model.nsensordata]]
        rows += ["s.sensordata"] if is_complete else [f"s.sensordata, {first}, {last}" for first, last in ranges]
        parts["sensors"] = sum(last - first for first, last in ranges)
    observe = [f"k = lw.put(obs, {'k' if i else 0}, {row})" for i, row in enumerate(rows)]

    settings = []
    controls = model.actuator_ctrlrange
    if model.actuator_ctrllimited.all() and (controls[:, 0] < controls[:, 1]).all() and (abs(controls) != 1.0).any():
        settings.append("action_range = (-1.0, 1.0)  # scaled to the controls' ranges; without it: the controls")
    if "home" in elements.get("keyframes", []):
        settings.append('keyframe = "home"  # where episodes start')
    step = substeps(model) * model.opt.timestep
    horizon = max(1, round(_EPISODE / step))
    return _filled(
        "plain",
        model,
        element=f"{kind}({literal(example)})",
        element_field=field,
        names="".join(f"#   {line}\n" for line in lists),
        fields=_indented(fields),
        observe=_indented(observe),
        parts=", ".join(f'"{name}": {size}' for name, size in parts.items()),
        settings=_added(settings),
        horizon=horizon,
        seconds=f"{horizon * step:.3g}",
        **names,
    )


def velocity_text(legs: Legs, **names: str) -> str:
    """Write a task file for a walking robot.

    Args:
        legs: The robot.
        **names: ``file``, ``class_name``, and ``source``, which is the model as a Python expression.
    """
    is_biped = len(legs.feet) == 2
    fastest = round(0.4 * float(np.sqrt(9.81 * legs.height)), 1)
    swing = max(foot.height for foot in legs.feet) - legs.ground + float(np.clip(0.1 * legs.height, 0.03, 0.1))
    params = []
    if is_biped:
        params.append(f"least_height: float = {0.45 * legs.height:.2f}  # of the base; an episode ends below it")
    if not legs.has_home:
        params.append(f"start_height: float = {legs.height:.3f}")
    return _filled(
        "velocity",
        legs.model,
        training=TRAINING,
        family="Biped" if is_biped else "Velocity",
        params_family="BipedParams" if is_biped else "Params",
        swing_target=f"{swing:.3g}",
        fastest=f"{fastest:g}",
        lateral=f"{fastest / 2:g}",
        keyframe='"home"' if legs.has_home else None,
        **_robot(legs, "walkers.prepare_walker(spec, FEET)", *params),
        **names,
    )


def tracking_text(legs: Legs, **names: str) -> str:
    """Write a task file for a robot that follows clips. The arguments are those of ``velocity_text``.

    The end effectors are the ends of all limbs. Bodies without a name are not tracked.
    """
    model, inner = legs.model, set[int]()
    tree = [body for body in range(1, model.nbody) if model.body_rootid[body] == model.body_rootid[legs.base]]
    bodies = [body for body in tree if model.body(body).name and body != legs.base]
    for body in bodies:
        while body := int(model.body_parentid[body]):
            inner.add(body)
    ends = [body for body in bodies if body not in inner]
    ordered = [legs.base, *ends, *(body for body in bodies if body not in ends)]
    tracked = _list("BODIES", [literal(model.body(body).name) for body in ordered])
    robot = _robot(legs, "tracking.prepare(spec, FEET)")
    return _filled("tracking", model, bodies=tracked, ends=len(ends), **robot, **names)


def actuated_joints(model: mujoco.MjModel) -> list[str]:
    """List the names of the joints that have an actuator, in the model's order."""
    moved = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    return [model.joint(joint).name for joint in sorted(set(moved.tolist()))]


def _robot(legs: Legs, prepare: str, *params: str) -> dict[str, object]:
    """Write what families of tasks share: feet, joints, the lines of ``edit_model``, and lines of ``Params``."""
    feet, edits = [f"FEET = [{', '.join(literal(foot.site) for foot in legs.feet)}]"], [prepare]
    if legs.has_motors:
        edits.insert(0, "walkers.use_servos(spec, JOINTS)")
    if new := [foot for foot in legs.feet if foot.element]:
        feet += ["NEW_SITES = {  # a body, or a joint or geom in it, and a position there"]
        feet += [f"    {literal(foot.site)}: ({literal(foot.element)}, {foot.position})," for foot in new]
        feet += ["}"]
        edits.insert(0, "walkers.add_feet(spec, NEW_SITES)")
    pose = [] if legs.has_home else [_list("default_pose: wp.array[float]", [f"{a:.4g}" for a in legs.pose], 4)]
    joints, njoint = _list("JOINTS", list(map(literal, legs.joints))), len(legs.joints)
    return dict(feet="\n".join(feet), joints=joints, njoint=njoint, params=_added([*params, *pose]),
                edits=_indented(edits, 8))  # fmt: skip


def _filled(template: str, model: mujoco.MjModel, **values: object) -> str:
    text = Path(__file__).with_name("templates").joinpath(f"{template}.txt").read_text("utf-8")
    substep = f"{1000 * model.opt.timestep:g}"
    return string.Template(text).substitute(values, frame_skip=substeps(model), substep_ms=substep)


def _sensor_ranges(model: mujoco.MjModel) -> list[list[int]]:
    """Return the ranges of ``sensordata`` that measure the state."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return []
    is_observed = np.repeat(~np.isin(model.sensor_type, _UNOBSERVED), model.sensor_dim)
    edges = np.flatnonzero(np.diff(is_observed, prepend=False, append=False))
    ranges: list[list[int]] = edges.reshape(-1, 2).tolist()
    return ranges


def _elements(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Return the printable names of the model's elements by their kinds."""
    mocap = np.flatnonzero(model.body_mocapid >= 0)
    elements = {
        "bodies": map(model.body, range(1, model.nbody)),
        "joints": map(model.joint, range(model.njnt)),
        "sites": map(model.site, range(model.nsite)),
        "sensors": map(model.sensor, range(model.nsensor)),
        "actuators": map(model.actuator, range(model.nactuator)),
        "keyframes": map(model.key, range(model.nkey)),
        "mocap bodies": map(model.body, mocap),
    }
    names = {
        kind: [one.name for one in group if one.name.isprintable() and one.name] for kind, group in elements.items()
    }
    return {kind: group for kind, group in names.items() if group}


def _list(name: str, literals: Sequence[str], indent: int = 0) -> str:
    """Write the assignment of a list, in several lines if necessary."""
    text = ", ".join(literals)
    if indent + len(f"{name} = [{text}]") <= 120:
        return f"{name} = [{text}]"
    margin = (indent + 4) * " "
    lines = textwrap.fill(f"{text},", 120, initial_indent=margin, subsequent_indent=margin, break_long_words=False)
    return f"{name} = [\n{lines}\n{indent * ' '}]  # fmt: skip"


def _indented(lines: Sequence[str], indent: int = 4) -> str:
    return textwrap.indent("\n".join(lines), indent * " ")


def _added(lines: Sequence[str]) -> str:
    """Write lines that follow another line of a class."""
    return "".join(f"\n    {line}" for line in lines)
