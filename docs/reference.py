"""Generate the site's reference from the package: public names, and tables of tasks.

tests/test_docs.py checks that every public name and every task appears exactly once.
"""

import dataclasses
import inspect
import json
import re
import sys
import types
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp
from gallery import shortest_command, turnable_tasks
from sphinx.ext.napoleon import Config, GoogleDocstring

import lyceum_warp as lw
from lyceum_warp.binding import file_name, find_task
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.core.spaces import action_space
from lyceum_warp.core.task import Element, FromModel
from lyceum_warp.support.docstrings import attribute_docs
from lyceum_warp.viewer.window.actions import HELP

DOCS = Path(__file__).parent

ALIASES = {
    "Row": ("class", "One world's values of a field; inside a kernel, a one-dimensional Warp array."),
    "quat": ("class", "A quaternion in MuJoCo's order w, x, y, z: ``wp.vec4``."),
    "vec10": ("class", "The ten numbers of a contact's or a geom's row that Warp has no name for."),
}
"""Kinds and descriptions of the public names that are Warp objects."""

TYPES = {"float32": "float", "int32": "int", "vec2f": "wp.vec2", "vec3f": "wp.vec3", "vec4f": "lw.quat",
         "mat33f": "wp.mat33", "spatial_vectorf": "wp.spatial_vector", "Any": "Any"}  # fmt: skip
"""Maps Warp's name of a type to its name in task files."""

OBSERVATIONS = json.loads((DOCS / "observations.json").read_text())
"""For each task and group of observations, the joint and the unit of indices; see observations.py."""

UNITS = {
    "m": "anchor_position ball ball_to_target body_position cube_from_grip cylinder dist_to_target error errors "
    "extremities fingers fingertip foot_height goal hammer hand handle handles_from_grips head_height "
    "height_scan nail palm palm_error palm_to_ball palm_to_target palms position_error target_position "
    "tips to_grip to_target widths",
    "m/s": "ball_velocity com_velocity linear_velocity torso_velocity",
    "rad": "euler reference_joint_position",
    "rad/s": "object_angular_velocity reference_joint_velocity",
    "m/s, m/s, rad/s": "command body_velocities",
    "rad/s, m/s": "body_velocity",
    "m/s², rad/s": "imu",
    "N": "constraint_force",
    "N m": "actuator_force",
    "s": "foot_air_time",
    "kg m², kg m, kg": "inertia",
}
"""The units of parts that are not single joints' positions and velocities. Other parts have no unit."""
UNIT_OF = {part: unit for unit, parts in UNITS.items() for part in parts.split()}

METHODS = (types.FunctionType, property, classmethod, staticmethod)

SECTIONS = Config(napoleon_custom_sections=["Functions"], napoleon_use_rtype=False)


# public names


def names(text: str) -> str:
    """Return the documentation of the public names in ``text``."""
    return "\n".join(["```{eval-rst}", *(line for name in text.split() for line in entry(lw, name)), "```"])


def modules(text: str) -> str:
    """Return the documentation of the modules in ``text``, such as ``walkers``."""
    lines = ["```{eval-rst}"]
    for word in text.split():
        module = getattr(lw, word)
        sys.modules[f"lw.{word}"] = module
        public = [
            name for name, value in vars(module).items()
            if not name.startswith("_") and inspect.isfunction(value) and value.__module__ == module.__name__
        ]  # fmt: skip
        lines += [line for name in public for line in entry(module, name, f"lw.{word}")]
    return "\n".join([*lines, "```"])


def entry(module: Any, name: str, prefix: str = "lw") -> list[str]:
    """Return a name's documentation as lines of reStructuredText."""
    value = getattr(module, name)
    if name in ALIASES:
        kind, text = ALIASES[name]
        return [f".. py:{kind}:: {prefix}.{name}", "", f"   {text}", ""]
    if isinstance(value, wp.Function):
        return warp_function(value, f"{prefix}.{name}")
    if not isinstance(value, type):
        return [f".. autofunction:: {prefix}.{name}", ""]
    lines = [f".. autoclass:: {prefix}.{name}"]
    if public := members(value):
        lines.append(f"   :members: {', '.join(public)}")
    bases = [f"``lw.{base.__name__}``" for base in value.__mro__[1:] if is_public(base)]
    return [*lines, "", *([f"   Members as in {' and '.join(bases)}.", ""] if bases else [])]


def is_public(cls: type) -> bool:
    """Return whether a class is a public name of the package."""
    return cls.__module__.startswith("lyceum_warp.") and cls.__name__ in lw.__all__


def members(cls: type) -> list[str]:
    """Return the names of a class's public members that have docstrings; include members of private base classes."""
    members: dict[str, None] = {}
    for base in reversed(cls.__mro__):
        if base is cls or (base.__module__.startswith("lyceum_warp.") and not is_public(base)):
            members |= dict.fromkeys(attribute_docs(base))
            members |= {
                name: None for name, value in vars(base).items() if isinstance(value, METHODS) and value.__doc__
            }
    return [name for name in members if not name.startswith("_")]


def convert(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Convert a docstring to reStructuredText. Omit attributes, because they are documented as members."""
    if what == "class" and "Attributes:" in lines:
        del lines[lines.index("Attributes:") :]
    lines[:] = converted("\n".join(lines))


def converted(text: str) -> list[str]:
    """Convert a docstring to lines of reStructuredText; outside of code, escape vertical bars and ``file:``."""
    text = re.sub(r"(``.*?``)|(\||\bfile(?=:))", lambda match: match[1] or f"\\{match[2]}", text, flags=re.DOTALL)
    return str(GoogleDocstring(text, SECTIONS)).splitlines()


def short_signature(app: Any, what: str, name: str, obj: Any, options: Any, signature: str, result: str) -> Any:
    """Shorten a signature: omit a dataclass's fields and private arguments, and shorten default objects."""
    if what == "class" and dataclasses.is_dataclass(obj):
        return "", result
    signature = signature and re.sub(r"(, \*)?(, _\w+=\w+)+(?=\))", "", signature)
    return signature and re.sub(r"(PhysicsOptions)\(.*?\)", r"\1()", signature), result


def warp_function(function: Any, name: str) -> list[str]:
    """Return a Warp function's documentation: signatures of all overloads, and the docstring."""
    overloads: dict[tuple[str, ...], dict[str, dict[str, None]]] = {}
    for overload in dict.fromkeys(each.func for each in (*function.user_overloads.values(),
                                                         *function.user_templates.values())):  # fmt: skip
        signature = inspect.signature(overload)
        kinds = overloads.setdefault(tuple(signature.parameters), {})
        for argument in signature.parameters.values():
            kinds.setdefault(argument.name, {})[type_name(argument.annotation)] = None
        kinds.setdefault("return", {})[type_name(signature.return_annotation)] = None
    heads = []
    for arguments, kinds in overloads.items():
        spelled = {each: "Any" if "Any" in names else " | ".join(names) for each, names in kinds.items()}
        result = f" -> {spelled['return']}" if spelled["return"] else ""
        heads.append(f"{name}({', '.join(f'{each}: {spelled[each]}' for each in arguments)}){result}")
    lines = [f".. py:function:: {heads[0]}", *(f"                 {head}" for head in heads[1:]), ""]
    return [*lines, *(f"   {line}" for line in converted(inspect.getdoc(function) or "")), ""]


def type_name(annotation: Any) -> str:
    """Return the name of a type in task files, or "" for a missing annotation."""
    if annotation is inspect.Signature.empty or annotation is None:
        return ""
    text = annotation.__name__ if isinstance(annotation, type) else repr(annotation)
    text = re.sub(r"[\w.]+", lambda word: TYPES.get(word[0].rpartition(".")[2], word[0]), text)
    return re.sub(r"^wp\.array\[", "Row[", text)


# tasks


def tasks(text: str) -> str:
    """Return a section for each task in ``text``."""
    return "\n\n".join(map(task_section, text.split()))


def task_section(name: str) -> str:
    """Return the section that describes a task."""
    task = BoundTask(find_task(name))
    cls = task.definition
    text = vars(cls).get("__doc__") or inspect.getdoc(sys.modules[cls.__module__]) or ""
    head, _, body = text.partition("\n\n")
    about = sentence(head.partition(": ")[2] or head)
    lines = [f"## {name}", ""]
    picture = f"images/gallery/{file_name(name)}.webp"
    if (DOCS / picture).exists():
        lines += [f"![{name}](../{picture})", ""]
    lines += ["```", *commands(name, cls, shown=(DOCS / picture).exists()), "```", ""]
    lines += [turnable(name, "../"), "", about, "", markdown(body), "", *facts(task), ""]
    for group, layout in task.layouts.obs.items():
        lines += observations(group, layout, OBSERVATIONS.get(name, {}).get(group, {}))
    lines += actions(task)
    lines += metrics(task)
    rows = parameters(task)
    if rows:
        documented = any(row[2] for row in rows)
        parameter_lines = table(("parameter", "default", "meaning"), rows) if documented else table(
            ("parameter", "default"), [row[:2] for row in rows])  # fmt: skip
        lines += parameter_lines if len(rows) <= 12 else folded(f"{len(rows)} parameters", parameter_lines)
    source = Path(sys.modules[cls.__module__].__file__ or "")
    place = source.relative_to(DOCS.parent).as_posix()
    code = [f"```{{literalinclude}} /{place}", ":language: python", "```", ""]
    return "\n".join([*lines, *folded(f"The file <code>{place}</code>", code)])


def commands(name: str, cls: type[lw.Task], *, shown: bool) -> list[str]:
    """Return the commands that show and train a task. ``shown`` tells whether the gallery shows the task."""
    lines = [shortest_command(name)] if shown or cls.planning.settings else []
    if ".balance." not in cls.__module__:  # those tasks are for planners
        teacher = " --teacher RUN" if cls.training.algorithm == "distill" else ""
        lines.append(f"lyceum-warp train {name}{teacher}")
    return lines


def observations(group: str, layout: dict[str, int], sources: dict[str, list[str]]) -> list[str]:
    """Return a table of a group's observations. A part has a row per number if many joints have their own."""
    title = "observation" if group == "policy" else f"`{group}` observation"
    rows: list[tuple[str, ...]] = []
    end = 0
    for part, size in layout.items():
        end, start = end + size, end
        joints = [sources.get(str(i), ("", "")) for i in range(start, end)]
        if 3 * len({joint for joint, _ in joints if joint}) >= size:  # a height scan depends on the base only
            rows += [
                (f"{start + i}", f"`{part}`", joint, unit or UNIT_OF.get(part, ""))
                for i, (joint, unit) in enumerate(joints)
            ]
        else:
            place = f"{start} to {end - 1}" if size > 1 else f"{start}"
            rows.append((place, f"`{part}`", "", UNIT_OF.get(part, "")))
    head = f"{title}, {count(end, 'number')}"
    lines = table(("index", head, "joint", "unit"), rows)
    return lines if len(rows) <= 12 else folded(head, lines)


def frame(name: str, up: str) -> str:
    """Return the frame of a robot that can be turned; ``up`` is the path from the page to docs/."""
    page = f"{up}turnable/{file_name(name)}.html"
    return f'<iframe src="{page}" title="{name}: drag to turn the view" loading="lazy"></iframe>'


def turnable(name: str, up: str = "") -> str:
    """Return a fold with a task's robot, if it can be turned."""
    if name.strip() not in turnable_tasks():
        return ""
    return f'<details class="turnable"><summary>Turn the robot</summary>{frame(name.strip(), up)}</details>'


def facts(task: BoundTask) -> list[str]:
    """Return a table of a task's timing, physics and planner settings."""
    cls, seconds = task.definition, task.timestep
    rows = [
        ("step", f"{seconds:g} s, {count(task.frame_skip, 'substep')} of {1000 * task.model.opt.timestep:g} ms"),
        ("episode", f"{cls.horizon} steps, {cls.horizon * seconds:g} s" if cls.horizon else "no limit"),
    ]
    if cls.gymnasium:
        rows.append(("the same as", f"Gymnasium's `{cls.gymnasium}`"))
    if cls.physics:
        rows.append(("further physics", ", ".join(f'`physics="{name}"`' for name in cls.physics)))
    if task.functions["success"] is not None:
        rows.append(("success", "yes" if cls.success_steps == 1 else f"after {cls.success_steps} steps in a row"))
    if cls.planning.settings:
        settings = ", ".join(f"{name} {shortened(value)}" for name, value in cls.planning.settings.items())
        rows.append(("MPPI's settings", settings))
    return table(("", ""), rows)


def shortened(value: Any) -> str:
    """Format a setting. For a long list, return only its length."""
    return f"({len(value)} numbers)" if isinstance(value, list | tuple) and len(value) > 3 else f"{value}"


def actions(task: BoundTask) -> list[str]:
    """Return a table of actions and bounds. Successive actions with equal bounds share a row."""
    space = action_space(task.model, task.definition.action_range, task.layouts.actions)
    assert space.low is not None and space.high is not None
    rows: list[tuple[list[str], int, str]] = []
    for part, columns in space.parts.items():
        bounds = dict.fromkeys(zip(space.low[columns].tolist(), space.high[columns].tolist(), strict=True))
        text = ", ".join("none" if np.isinf(high) else f"{low:.3g} to {high:.3g}" for low, high in bounds)
        if rows and rows[-1][2] == text:
            rows[-1] = ([*rows[-1][0], part], rows[-1][1] + columns.stop - columns.start, text)
        else:
            rows.append(([part], columns.stop - columns.start, text))
    places = indices([size for _, size, _ in rows])
    joints = {} if task.layouts.actions else dict(zip(space.parts, actuated_joints(task.model), strict=True))
    cells = [(place, ", ".join(f"`{part}`{joints.get(part, '')}" for part in parts), text)
             for place, (parts, _, text) in zip(places, rows, strict=True)]  # fmt: skip
    return table(("index", f"action, {count(space.size, 'number')}", "bounds"), cells)


def actuated_joints(model: mujoco.MjModel) -> list[str]:
    """Return the name of each actuator's joint in parentheses, or "" without one or where the names are equal."""
    kind = mujoco.mjtTrn.mjTRN_JOINT
    names = [model.joint(model.actuator_trnid[i, 0]).name if model.actuator_trntype[i] == kind else ""
             for i in range(model.nu)]  # fmt: skip
    return [f" ({name})" if name not in ("", model.actuator(i).name) else "" for i, name in enumerate(names)]


def indices(sizes: list[int]) -> list[str]:
    """Return the range of indices of each part of an array."""
    ends = np.cumsum(sizes).tolist()
    return [f"{end - size} to {end - 1}" if size > 1 else f"{end - 1}" for end, size in zip(ends, sizes, strict=True)]


def metrics(task: BoundTask) -> list[str]:
    """Return a table of the metrics, with the weights of reward terms."""
    weights, ends = task.definition.rewards, task.definition.terminations
    if not weights and not ends:
        return [f"Metrics: {', '.join(f'`{name}`' for name in task.metrics)}.", ""] if task.metrics else []
    rows = [(f"`{name}`", f"{weights[name]:g}" if name in weights else "ends the episode" if name in ends else "")
            for name in task.metrics]  # fmt: skip
    return table(("metric", "weight in the reward"), rows)


def parameters(task: BoundTask) -> list[tuple[Any, ...]]:
    """Return the parameters, their defaults, and their comments in the task's files."""
    meanings = attribute_docs(*reversed(task.source.defaults.__mro__[:-1]))
    rows = []
    for name in task.source.params.vars:
        if name in ("dt", "substep_dt"):
            continue
        default = getattr(task.source.defaults, name)
        first = default[0] if isinstance(default, list) and default else default
        index = f"index in `{first.field}`" if isinstance(first, Element) else ""
        meaning = meanings.get(name, index).replace("|", "\\|").replace("*", "\\*")
        rows.append((f"`{name}`", spelled(default, task.parameters.values[name]), meaning))
    return rows


def spelled(default: Any, value: Any) -> str:
    """Format a default value for a table."""
    elements = default if isinstance(default, list) else [default]
    if isinstance(default, FromModel):
        return "from the model"
    if elements and all(isinstance(each, Element) for each in elements):
        names = ", ".join(each.name for each in elements)
        return f"{names if len(names) < 40 else names[:40] + ' …'}"
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "fiub" or numbers.size > 12:
        return f"table, {' x '.join(map(str, numbers.shape))}"
    if numbers.ndim == 0:
        return str(value) if numbers.dtype.kind == "b" else f"{value:.6g}"
    return ", ".join(f"{number:.6g}" for number in numbers.ravel().tolist())


def keys(_: str) -> str:
    """Return a table of what the mouse and the keys do in the viewer."""
    return "\n".join(table(("mouse or key", ""), list(HELP)))


# Markdown


def table(headings: tuple[str, ...], rows: list[tuple[Any, ...]]) -> list[str]:
    """Format a table in Markdown, followed by a blank line."""
    cells = [headings, ("---",) * len(headings), *rows]
    return [*(f"| {' | '.join(map(str, row))} |" for row in cells), ""]


def count(number: int, noun: str) -> str:
    """Format a number with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def folded(title: str, lines: list[str]) -> list[str]:
    """Put lines into a collapsible block."""
    title = re.sub(r"`(.+?)`", r"<code>\1</code>", title)
    return [f"<details><summary>{title}</summary>", "", *lines, "", "</details>", ""]


def markdown(text: str) -> str:
    """Convert a docstring to Markdown."""
    return re.sub(r"``(.+?)``", r"`\1`", text)


def sentence(text: str) -> str:
    """Format a description as a sentence with a capital and a full stop."""
    text = " ".join(text.split())
    return f"{text[0].upper()}{text[1:].rstrip('.')}."
