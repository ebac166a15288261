"""Play back episodes: sequences of states, with rewards if they are known."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.controllers import Trajectory, check_episode
from lyceum_warp.core import Done
from lyceum_warp.env import Env
from lyceum_warp.support.validate import described


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """The states of one world in an episode."""

    name: str
    states: np.ndarray
    """The states, (steps + 1, state_space.size) float64."""
    rewards: np.ndarray
    """The reward of each step, (steps,), or NaN if unknown."""
    evals: np.ndarray
    """The evaluation metric after each step, (steps,), or NaN if unknown."""
    end: str = ""
    """The reason why the episode ended, or ""."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.states) - 1


def reasons(bits: int) -> str:
    """Format the bits of ``Done`` as text."""
    return ", ".join(str(bit.name).lower().replace("_", " ") for bit in Done if bits & bit)


def episodes_of(given: Any, env: Env) -> list[Episode]:
    """Load the episodes to play back."""
    if isinstance(given, str | Path | Trajectory | torch.Tensor):
        given = [given]
    if isinstance(given, Mapping):
        return [_episode(name, each, env) for name, each in given.items()]
    if not isinstance(given, Sequence):
        raise ValueError(
            f"episodes must be a list or a dict of trajectories, episode files or state tensors, not {described(given)}"
        )
    names = [Path(each).name if isinstance(each, str | Path) else f"episode {i}" for i, each in enumerate(given)]
    return [_episode(name, each, env) for name, each in zip(names, given, strict=True)]


def _episode(name: str, given: Any, env: Env) -> Episode:
    if isinstance(given, str | Path):
        given = Trajectory.load(given)
    if isinstance(given, Trajectory):
        check_episode(env, given, name)
        rewards, evals = (values.double().numpy() for values in (given.rewards, given.evals))
        end = "success" if given.steps and given.succeeded else reasons(given.done_reason)
        return Episode(name, given.states.numpy(), rewards, evals, end)
    size = env.state_space.size
    if not isinstance(given, torch.Tensor) or given.ndim != 2 or given.shape[1] != size or not len(given):
        raise ValueError(
            f"an episode of {env.task.name!r} must be a Trajectory, a file of a Trajectory, or states of shape (steps, "
            f"{size}) as env.get_state() returns them, not {described(given)}"
        )
    unknown = np.full(len(given) - 1, np.nan)
    states = given.detach().to("cpu", torch.float64).numpy().copy()
    return Episode(name, states, unknown, unknown)


class Playback:
    """Holds episodes, and the displayed step of one episode."""

    def __init__(self, episodes: Sequence[Episode]) -> None:
        self.episodes = list(episodes)
        self.index, self.step, self.backwards = 0, 0, False

    @property
    def episode(self) -> Episode:
        """The displayed episode."""
        return self.episodes[self.index]

    @property
    def state(self) -> np.ndarray:
        """The displayed state, (state_space.size,) float64."""
        return self.episode.states[self.step]

    @property
    def next_step(self) -> int:
        """The next step in the direction of the playback. After the last step comes the first."""
        return (self.step + (-1 if self.backwards else 1)) % (self.episode.steps + 1)

    def choose(self, index: int) -> None:
        """Show another episode at the same step. If it is shorter, show its last step."""
        self.index = index
        self.seek(self.step)

    def seek(self, step: int) -> None:
        """Show a step, clipped to the episode."""
        self.step = min(max(step, 0), self.episode.steps)

    def around(self, count: int) -> list[int]:
        """Return at most ``count`` evenly spaced steps of the episode, except the displayed step."""
        last = self.episode.steps
        steps = {round(i * last / max(count - 1, 1)) for i in range(count)}
        return sorted(steps - {self.step})
