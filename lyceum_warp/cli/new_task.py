"""Write a task file for a model: lyceum-warp new."""

import dataclasses
import importlib.util
import keyword
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import tyro

from lyceum_warp import core
from lyceum_warp.binding import compile_model, find_task, package_task_names, snake_case
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.cli.task_text import TRAINING, actuated_joints, literal, plain_text, tracking_text, velocity_text
from lyceum_warp.models import Legs
from lyceum_warp.support.files import replace_text

_SOURCES: dict[str, Callable[[str], core.ModelFile]] = {
    "menagerie": core.menagerie_model,
    "gymnasium": core.gymnasium_model,
    "gymnasium_robotics": core.gymnasium_robotics_model,
}

_TAKEN = ("World", "Params", "Row")
"""Names that a generated file already uses. A task's class cannot have them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class New:
    """Write a task file for a model. The task can be checked, stepped and trained immediately, but its reward is zero.

    The policy observes positions, velocities, activations and sensors, and acts through the model's actuators. A step
    lasts about 20 ms. Comments in the file explain the next steps.

    $ lyceum-warp new walk --model robots/dog.xml
    $ lyceum-warp new tasks/hop.py --model gymnasium:hopper.xml
    $ lyceum-warp new go1_walk --model menagerie:unitree_go1/scene.xml
    $ lyceum-warp new g1_walk --model menagerie:unitree_g1/scene_mjx.xml
    $ lyceum-warp new my_tracking --model robot.xml --template tracking
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """The task's name in snake_case, or a path such as path/to/task.py. For a name, the command writes the file TASK.py
    in the working directory."""
    model: Annotated[str, tyro.conf.arg(metavar="FILE")]
    """An MJCF or URDF file, or a model in a package: gymnasium:FILE.xml, gymnasium_robotics:PATH or
    menagerie:ROBOT/FILE.xml. MuJoCo Menagerie comes from the extra "menagerie", from the package mujoco-menagerie, or
    from a checkout to which MENAGERIE_ROOT points.
    """

    template: Literal["plain", "velocity", "tracking"] = "plain"
    """The template "velocity" trains a walking robot to follow velocity commands, and "tracking" to follow clips. The
    robot needs a floating base, and legs made of hinges with one actuator each. The file is short, because it inherits
    most of its functions.
    """
    feet: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """The names of the feet, for --template velocity or tracking: sites, geoms or bodies. The default is the lowest end
    of each leg."""
    joints: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Names of the joints to control, for --template velocity or tracking. The default is all leg joints with an
    actuator, or, for tracking, all joints with an actuator. Other joints keep their pose.
    """

    def run(self) -> None:
        if self.template == "plain" and (self.feet or self.joints):
            raise ValueError("--feet and --joints have no effect without --template velocity or tracking")
        path = Path(os.path.expanduser(self.task if self.task.endswith(".py") else f"{self.task}.py"))
        class_name = _class_name(path)
        if path.exists():
            raise ValueError(f"{path} exists: choose another name, or remove it")
        source, spec = _model(self.model, path)
        names = {"file": path.name, "class_name": class_name, "source": source}
        try:
            model = compile_model(spec, ("sensordata",), core.PhysicsOptions())
            if model.nu == 0:
                raise ValueError("the model has no actuators, so actions would have no effect: add actuators")
            if model.nv == 0:
                raise ValueError("the model has no joints, so its bodies cannot move: add joints")
            if self.template == "plain":
                text = plain_text(model, **names)
            else:
                tracks = self.template == "tracking"
                legs = Legs(model, self.feet, self.joints or (actuated_joints(model) if tracks else ()))
                text = (tracking_text if tracks else velocity_text)(legs, **names)
        except ValueError as error:
            raise ValueError(f"{self.model}: {error}") from error
        replace_text(path, text)
        task = find_task(path)
        if self.template == "plain":
            step_ms = 1000 * task.frame_skip * model.opt.timestep
            sizes = f"{sum(task.obs.values())} observations, {model.nu} actions, {step_ms:.3g} ms in a step"
        else:
            sizes = f"feet {', '.join(foot.site for foot in legs.feet)}; joints {', '.join(legs.joints)}"
        training = {"plain": "", "velocity": f" {TRAINING}", "tracking": " --clips FILES --device cuda"}[self.template]
        say(f"{path}: {sizes}")
        if self.template != "plain":
            cone = next(name for name, kind in core.CONES.items() if kind == model.opt.cone)
            physics = f"{task.frame_skip} substeps of {1000 * model.opt.timestep:g} ms with {cone} friction cones"
            say(f"a step has {physics}; lyceum-warp tune {path} finds faster physics")
        say_entries(next=f"lyceum-warp check {path}", then=f"lyceum-warp train {path}{training}")


def _class_name(path: Path) -> str:
    name = path.stem
    class_name = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    if not re.fullmatch("[A-Za-z]+[A-Za-z0-9_]*", name) or keyword.iskeyword(name) or keyword.iskeyword(class_name):
        raise ValueError(f"a task can't be named {name!r}: use letters, digits and _, as in my_robot")
    if snake_case(class_name) != name:  # the class name determines the task's name
        raise ValueError(f"a task can't be named {name!r}: use {snake_case(class_name)!r}, for the class {class_name}")
    if class_name in _TAKEN:
        raise ValueError(f"a task can't be named {name!r}: its file defines {class_name} for another purpose")
    if name in package_task_names():
        raise ValueError(f"the task name {name!r} is taken by a task of the package: choose another")
    module = importlib.util.find_spec(name)
    if module is not None and module.origin is not None and Path(module.origin).parent != path.absolute().parent:
        raise ValueError(f"a task can't be named {name!r}: its file would hide the Python module of this name")
    return class_name


def _model(text: str, path: Path) -> tuple[str, mujoco.MjSpec]:
    """Return the Python expression for a model in a task file, and the model."""
    where, _, file = text.partition(":")
    if where in _SOURCES:
        return f"lw.{where}_model({literal(file)})", _SOURCES[where](file).spec()
    model = Path(os.path.expanduser(text))
    if not model.is_file():
        raise FileNotFoundError(f"there is no model file {text!r}")
    place = model if model.is_absolute() else Path(os.path.relpath(model, path.parent))
    return literal(place.as_posix()), core.read_spec(model)
