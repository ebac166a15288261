"""Define ``lw.Trajectory``, which stores one episode of a controlled world and can be saved in a file."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.binding.registry import spelled_task
from lyceum_warp.core.done import Done
from lyceum_warp.env.env import Env
from lyceum_warp.support.files import replaced, unknown_format
from lyceum_warp.support.validate import first_sentence
from lyceum_warp.support.versions import versions

FORMAT = 1
"""Version of the file format. Increase it if older releases cannot read the new files."""

# dtype and axes of each array
_ARRAYS = {
    "states": (torch.float64, ("steps + 1", "state_size")), "obs": (torch.float32, ("steps + 1", "nobs")),
    "actions": (torch.float32, ("steps", "nu")), "rewards": (torch.float32, ("steps",)),
    "evals": (torch.float32, ("steps",)), "success": (torch.bool, ("steps",)),
    "times": (torch.float64, ("steps",)), "ages": (torch.float64, ("steps",)), "late": (torch.bool, ("steps",)),
    "plan_of": (torch.int64, ("steps",)), "plan_steps": (torch.int64, ("plans",)),
    "plan_starts": (torch.float64, ("plans",)), "plan_times": (torch.float64, ("plans",)),
    "plan_failed": (torch.float64, ("plans",)), "plan_effective": (torch.float64, ("plans",)),
}  # fmt: skip
_SCALARS: dict[str, Callable[[Any], Any]] = {
    "timestep": float, "period": float, "wall_seconds": float, "mode": str, "done_reason": int, "task": str,
    "engine": str, "params": dict, "versions": dict, "seed": lambda seed: seed if seed is None else int(seed),
    "controller": dict, "state_parts": dict, "obs_parts": dict, "action_names": list, "source": dict,
}  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of a controlled world, the plant. All tensors are on the CPU.

    In step k, the plant moves from state k to state k + 1 under action k. To replay the episode bit for bit on the same
    engine, set the first state and step with each action.

    Except for ``timestep``, times are wall times in seconds. The clock starts before the first plan in a synchronous
    run, and after the first plan in an asynchronous run.
    """

    states: torch.Tensor
    """States, (steps + 1, state_size) float64. If a fault ends the episode, the world restarts in the same step. The
    last state then belongs to the next episode."""
    obs: torch.Tensor
    """Observations of the states, (steps + 1, nobs) float32. If a fault ended the episode, the last valid observation
    is repeated."""
    actions: torch.Tensor
    """Applied actions, (steps, nact) float32."""
    rewards: torch.Tensor
    """Rewards, (steps,) float32."""
    evals: torch.Tensor
    """Evaluation metric of the state after each step, (steps,) float32."""
    success: torch.Tensor
    """Whether the state after each step is a success, (steps,) bool."""
    times: torch.Tensor
    """Time at which each action was applied, (steps,) float64, in seconds."""
    ages: torch.Tensor
    """Age of each action when it was applied, (steps,) float64, in seconds. The age is the wall time since the plant
    was in the plan's initial state. In a synchronous run, the age of a plan's first action is the planning time."""
    late: torch.Tensor
    """Whether each step started late because the previous step took too long, (steps,) bool."""
    plan_of: torch.Tensor
    """Index of the plan that contains each action, (steps,) int64."""
    plan_steps: torch.Tensor
    """Index of each plan's initial state, (plans,) int64."""
    plan_starts: torch.Tensor
    """Time at which planning started, (plans,) float64, in seconds. The first plan of an asynchronous run has a
    negative time."""
    plan_times: torch.Tensor
    """Planning time, including the copy of the actions to the CPU, (plans,) float64, in seconds."""
    plan_failed: torch.Tensor
    """Number of failed samples of each plan, (plans,) float64; NaN if unknown."""
    plan_effective: torch.Tensor
    """Effective sample size of each plan, (plans,) float64: 0 if all samples failed, NaN if unknown."""
    timestep: float
    """Simulated duration of a step, in seconds."""
    period: float
    """Wall time between two steps, in seconds; equal to ``timestep`` in a synchronous run."""
    wall_seconds: float
    """Wall time of the run, in seconds."""
    mode: str
    """"sync" if the plant waited for each plan, "async" if it ran in real time."""
    done_reason: int
    """Reason why the episode ended, as bits of ``Done``; 0 if the run stopped earlier."""
    task: str
    """Name of the task."""
    engine: str
    """Name of the plant's engine."""
    params: Mapping[str, Any]
    """Parameters of the task, without large tables that were not given."""
    versions: Mapping[str, Any]
    """Versions of packages and Python, the machine, and the commit."""
    seed: int | None
    """Seed of the initial state and of the controller."""
    controller: Mapping[str, Any]
    """The controller's ``name``, settings, ``engine`` and ``device``. Unknown values are missing."""
    state_parts: Mapping[str, Sequence[int]]
    """Columns [start, stop] of each part of a state."""
    obs_parts: Mapping[str, Sequence[int]]
    """Columns [start, stop] of each part of an observation."""
    action_names: Sequence[str]
    """Names of the action columns."""
    pictures: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    """Pictures of the states by the cameras' groups, (steps + 1, height, width, channels); see ``lw.Camera``."""
    source: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The arguments of ``lw.make`` with which ``episode_env`` recreates the plant. ``task`` is a name or "file:class",
    or None for a task from a notebook or script. ``params`` lists the names of the given parameters, and ``options``
    has the options."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.actions)

    @property
    def episode_return(self) -> float:
        """Sum of the rewards."""
        return float(self.rewards.double().sum())

    @property
    def terminated(self) -> bool:
        """Whether the task's ``terminated`` ended the episode."""
        return bool(self.done_reason & Done.TERMINATED)

    @property
    def truncated(self) -> bool:
        """Whether the time limit or a fault ended the episode."""
        return bool(self.done_reason & ~Done.TERMINATED)

    @property
    def succeeded(self) -> bool:
        """Whether the last state is a success."""
        return bool(self.success[-1])

    @property
    def age_steps(self) -> torch.Tensor:
        """Age of each action in plant steps, (steps,) int64."""
        return torch.arange(self.steps) - self.plan_steps[self.plan_of]

    def part(self, name: str) -> torch.Tensor:
        """Get one part of every state as a view, (steps + 1, size). For example, ``part("qpos")`` gets the positions.

        Raises:
            ValueError: The states have no part of this name.
        """
        if name not in self.state_parts:
            raise ValueError(f"the states have no part {name!r}: they have {', '.join(self.state_parts)}")
        start, stop = self.state_parts[name]
        return self.states[:, start:stop]

    def save(self, path: str | Path) -> Path:
        """Write the trajectory to a file atomically, and return the file's path.

        The file is a compressed ``.npz`` that numpy reads without pickle. The array of each tensor has the same name as
        the tensor, and the array of a camera's pictures is ``pictures.GROUP``. The 0-d array ``info`` is a string with
        a JSON object. The JSON object holds all other attributes of the trajectory, and ``"format": 1``. For example,
        the positions are ``states[:, slice(*info["state_parts"]["qpos"])]``.
        """
        path = Path(path)
        info = {"format": FORMAT, **{name: getattr(self, name) for name in _SCALARS}, "pictures": [*self.pictures]}
        arrays: dict[str, Any] = {name: getattr(self, name).numpy() for name in _ARRAYS}
        arrays |= {f"pictures.{group}": pictures.numpy() for group, pictures in self.pictures.items()}
        arrays["info"] = np.array(json.dumps(info))
        path.parent.mkdir(parents=True, exist_ok=True)
        # numpy appends .npz to a path, but not to an open file
        with replaced(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)
        return path

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Read a file that ``save`` wrote. Loading runs no code from the file.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The file is broken, is not a trajectory, or comes from a newer release.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                info = json.loads(str(file["info"]))
                if info["format"] <= FORMAT:
                    content: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _ARRAYS}
                    groups = info.get("pictures", ())  # earlier releases saved none
                    pictures = {group: torch.from_numpy(file[f"pictures.{group}"]) for group in groups}
                    _check(content, pictures)
                    scalars = {name: kind(info[name]) for name, kind in _SCALARS.items()}
                    _check_scalars(scalars, content)
                    return cls(**content, **scalars, pictures=pictures)
        except Exception as error:  # numpy and zipfile raise many types of errors
            if isinstance(error, OSError) and error.filename is not None:
                raise  # the file cannot be opened
            reason = first_sentence(error)
            raise ValueError(f"{path} is broken, or is not a trajectory of lyceum_warp ({reason})") from error
        raise unknown_format(path, info["format"], FORMAT)


def _check(arrays: Mapping[str, torch.Tensor], pictures: Mapping[str, torch.Tensor]) -> None:
    steps = len(arrays["actions"])
    lengths = {"steps": steps, "steps + 1": steps + 1, "plans": len(arrays["plan_times"])}
    for name, (dtype, axes) in _ARRAYS.items():
        array = arrays[name]
        fits = array.ndim == len(axes) and array.dtype == dtype and len(array) == lengths[axes[0]]
        if not fits or not len(array):
            raise ValueError(f"{name} has type {array.dtype} and shape {tuple(array.shape)}")
    for group, array in pictures.items():
        if array.ndim != 4 or len(array) != steps + 1:
            raise ValueError(f"the pictures {group!r} have the shape {tuple(array.shape)}")
    if not ((arrays["plan_of"] >= 0) & (arrays["plan_of"] < lengths["plans"])).all():
        raise ValueError(f"plan_of has indices outside the {lengths['plans']} plans")


def _check_scalars(scalars: Mapping[str, Any], arrays: Mapping[str, torch.Tensor]) -> None:
    for name, array in (("state_parts", "states"), ("obs_parts", "obs")):
        for part, place in scalars[name].items():
            pair = isinstance(place, list) and len(place) == 2 and all(type(column) is int for column in place)
            if not pair or not 0 <= place[0] <= place[1] <= arrays[array].shape[1]:
                raise ValueError(f"{name} has {place!r} as the columns of {part!r}")
    source = scalars["source"]
    for name, kind in {"task": str | None, "params": list, "options": dict}.items():
        if name in source and not isinstance(source[name], kind):
            raise ValueError(f"source has {source[name]!r} as its {name}")
    if missing := [name for name in source.get("params", ()) if name not in scalars["params"]]:
        raise ValueError(f"source names the parameter {missing[0]!r}, but params has no such key")


def pictures_of(env: Env) -> dict[str, torch.Tensor]:
    """Copy the pictures of all worlds to the CPU, by the cameras' groups."""
    return {camera.group: env.obs_groups[camera.group].to("cpu", copy=True) for camera in env.task.cameras}


def stacked(pictures: Sequence[Mapping[str, torch.Tensor]], world: int) -> dict[str, torch.Tensor]:
    """Stack the pictures of a world that ``pictures_of`` has copied in each state of an episode."""
    return {group: torch.stack([each[group][world] for each in pictures]) for group in pictures[0]}


def provenance(env: Env) -> dict[str, Any]:
    """Collect the attributes of a trajectory that depend only on the environment."""
    params = {
        name: np.asarray(value).tolist()
        for name, value in env.task.params.items()
        if name in env.given_params or np.size(value) <= _LARGE
    }
    return {
        "task": env.task.name, "engine": env.engine.name, "params": params, "versions": versions(env.device.alias),
        "state_parts": {name: [part.start, part.stop] for name, part in env.state_space.parts.items()},
        "obs_parts": {name: [part.start, part.stop] for name, part in env.obs_space.parts.items()},
        "action_names": env.action_space.columns, "source": source(env),
    }  # fmt: skip


_LARGE = 10_000
"""Largest number of elements of a table that is stored although it was not given."""

_PLACEMENT = ("engine", "device", "nthread", "nworld", "seed", "first_world", "autoreset", "graphs", "fields")
"""Options that change neither the physics nor the states, and are not stored."""


def source(env: Env) -> dict[str, Any]:
    """Collect the arguments that recreate an environment; see ``Trajectory.source``."""
    task = env.task.definition
    options = {name: value for name, value in env.options.given().items() if name not in _PLACEMENT}
    if "cameras" in options:
        options["cameras"] = [dataclasses.asdict(camera) for camera in options["cameras"]]
    model = options.pop("model", None)
    if isinstance(model, str | Path):
        options["model"] = str(Path(model).resolve()) if Path(model).is_file() else str(model)
    return {
        "task": None if task.__module__ == "__main__" else spelled_task(task), "params": sorted(env.given_params),
        "options": json.loads(json.dumps(options, default=str)),
    }  # fmt: skip
