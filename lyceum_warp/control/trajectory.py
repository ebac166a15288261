"""Trajectories of controlled worlds: what happened, and when."""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.done import Done
from lyceum_warp.env import Env
from lyceum_warp.versions import versions

FORMAT = 1
"""Format of the file; one more whenever an older release could no longer read it."""

# every array of a trajectory: its type and axes, of which those with the same name have the same length
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
    "controller": dict, "state_parts": dict, "obs_parts": dict, "action_names": list,
}  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of one world under a controller. All tensors lie on the CPU.

    Step k leads from state k to state k + 1 under action k. ``set_state`` of the first state and the actions give
    all the others again, to the bit, on the engine that they come from.

    Times are seconds of the wall clock since the run's clock started: with the first plan in a synchronous run, after
    it in an asynchronous one.
    """

    states: torch.Tensor
    """States, (steps + 1, state_size) float64. After a fault the last one is where the world began again."""
    obs: torch.Tensor
    """Observations of the states, (steps + 1, nobs) float32. After a fault the last one is the last good one."""
    actions: torch.Tensor
    """Actions that were applied, (steps, nu) float32."""
    rewards: torch.Tensor
    """Rewards, (steps,) float32."""
    evals: torch.Tensor
    """The evaluation metric of the states that the steps led to, (steps,) float32."""
    success: torch.Tensor
    """Whether the task's goal was met there, (steps,) bool."""
    times: torch.Tensor
    """When each action was applied, (steps,) float64, seconds."""
    ages: torch.Tensor
    """How old each action was then, (steps,) float64, seconds: the time since the plant was in the state that the
    action was planned from. A plant that waits has not moved meanwhile: there it is what the plan took."""
    late: torch.Tensor
    """Whether a step began late because the one before it was not done in time, (steps,) bool; never if the plant
    waits."""
    plan_of: torch.Tensor
    """Which plan each action came from, (steps,) int64."""
    plan_steps: torch.Tensor
    """The step whose state each plan was made from, (plans,) int64."""
    plan_starts: torch.Tensor
    """When each plan was begun, (plans,) float64, seconds; negative for the first one of an asynchronous run."""
    plan_times: torch.Tensor
    """How long each plan took until its actions were there, (plans,) float64, seconds."""
    plan_failed: torch.Tensor
    """How many of the samples of each plan failed, (plans,) float64; NaN of controllers that don't tell."""
    plan_effective: torch.Tensor
    """The effective number of the samples of each plan, (plans,) float64: 0 if all failed; NaN where unknown."""
    timestep: float
    """Simulated seconds in a step."""
    period: float
    """Seconds of the wall clock that a step has: at which the plant runs, or would run in real time if it waits."""
    wall_seconds: float
    """Seconds of the wall clock that all of it took."""
    mode: str
    """"sync" if the plant waited for its plans, "async" if it kept its rate."""
    done_reason: int
    """Bits of ``Done``: why the episode ended; 0 if it went on, or was interrupted."""
    task: str
    """Name of the task."""
    engine: str
    """Name of the engine."""
    params: Mapping[str, Any]
    """The task's parameters."""
    versions: Mapping[str, Any]
    """Packages, Python, machine and commit."""
    seed: int | None
    """Seed of the initial state and of the controller, None if none was given."""
    controller: Mapping[str, Any]
    """What planned: its ``name``, and its settings, ``engine`` and ``device`` if it has them."""
    state_parts: Mapping[str, Sequence[int]]
    """Where the named parts of a state lie: [start, stop] in its columns."""
    obs_parts: Mapping[str, Sequence[int]]
    """Where those of an observation lie."""
    action_names: Sequence[str]
    """Names of the actions' columns."""

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
        """Whether the task, or a fault, ended the episode."""
        return bool(self.done_reason & ~Done.TRUNCATED)

    @property
    def truncated(self) -> bool:
        """Whether the time limit was reached."""
        return bool(self.done_reason & Done.TRUNCATED)

    @property
    def succeeded(self) -> bool:
        """Whether the task's goal was met at the end."""
        return bool(self.success[-1])

    @property
    def age_steps(self) -> torch.Tensor:
        """Steps between the state that each action was planned from and the action, (steps,) int64."""
        return torch.arange(self.steps) - self.plan_steps[self.plan_of]

    def save(self, path: str | Path) -> Path:
        """Write everything into one file, in one go: a reader finds the old file or the whole new one.

        The file is a compressed ``.npz``, which numpy reads by itself, without pickle. Each array has the name, the
        shape, the type and the unit of the attribute; ``info`` is JSON text, a string of no axis, with ``format``
        (1), ``task``, ``engine``, ``params``, ``versions``, ``mode``, ``timestep``, ``period``, ``wall_seconds``,
        ``done_reason``, ``seed``, ``controller``, ``state_parts``, ``obs_parts`` and ``action_names``: with
        ``start, stop = info["state_parts"]["qpos"]``, the positions are ``states[:, start:stop]``.

        Returns:
            The file's path.
        """
        path = Path(path)
        info = {"format": FORMAT, **{name: getattr(self, name) for name in _SCALARS}}
        arrays: dict[str, Any] = {name: getattr(self, name).numpy() for name in _ARRAYS}
        arrays["info"] = np.array(json.dumps(info))
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        try:
            with temporary.open("wb") as file:  # by name, numpy would add a suffix
                np.savez_compressed(file, **arrays)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Read a file that ``save`` wrote. Nothing in it is run.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is broken, foreign, or of a newer release.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                info = json.loads(str(file["info"]))
                if info["format"] <= FORMAT:
                    content: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _ARRAYS}
                    _check(content)
                    return cls(**content, **{name: kind(info[name]) for name, kind in _SCALARS.items()})
        except OSError:
            raise
        except Exception as error:  # numpy and zipfile raise many kinds, depending on where the file is broken
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"{path} is broken, or is no trajectory of lyceum_warp ({text[:200]})") from error
        raise ValueError(
            f"{path} was written by a newer lyceum_warp (format {info['format']}, this one reads up to {FORMAT}): "
            "pip install --upgrade lyceum-warp"
        )


def _check(arrays: Mapping[str, torch.Tensor]) -> None:
    """Refuse arrays that don't belong together."""
    steps = len(arrays["actions"])
    lengths = {"steps": steps, "steps + 1": steps + 1, "plans": len(arrays["plan_times"])}
    for name, (dtype, axes) in _ARRAYS.items():
        array = arrays[name]
        fits = array.ndim == len(axes) and array.dtype == dtype and len(array) == lengths[axes[0]]
        if not fits or not len(array):
            raise ValueError(f"{name} has type {array.dtype} and shape {tuple(array.shape)}")
    if not ((arrays["plan_of"] >= 0) & (arrays["plan_of"] < lengths["plans"])).all():
        raise ValueError("plan_of names plans that are not there")


def provenance(env: Env) -> dict[str, Any]:
    """What a trajectory tells of where it comes from: the task, the engine, versions, and the columns' names."""
    params = {name: np.asarray(value).tolist() for name, value in env.task.params.items()}
    return {
        "task": env.task.name, "engine": env.engine.name, "params": params, "versions": versions(env.device.alias),
        "state_parts": {name: [part.start, part.stop] for name, part in env.state_space.parts.items()},
        "obs_parts": {name: [part.start, part.stop] for name, part in env.obs_space.parts.items()},
        "action_names": list(env.action_space.parts),
    }  # fmt: skip
