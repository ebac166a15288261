"""Play back episodes: states one after another, with their rewards if these are known."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.controllers.saved_episodes import check_episode
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.done import Done
from lyceum_warp.env import Env
from lyceum_warp.support.validate import described


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """States of one world."""

    name: str
    states: np.ndarray
    """(steps + 1, state_space.size) float64."""
    rewards: np.ndarray
    """(steps,), NaN where unknown."""
    evals: np.ndarray
    """(steps,), NaN where unknown."""
    done_reason: int = 0
    """Bits of ``Done``: why it ended; 0 where it did not, or where this is unknown."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.states) - 1

    @property
    def end(self) -> str:
        """Why it ended, in words; empty where it did not."""
        return reasons(self.done_reason)


def reasons(bits: int) -> str:
    """The names of the bits of ``Done``, in lower case."""
    return ", ".join(str(bit.name).lower().replace("_", " ") for bit in Done if bits & bit)


def episodes_of(given: Any, env: Env) -> list[Episode]:
    """The episodes to play back.

    Args:
        given: Trajectories, files of them, tensors of states, (steps + 1, state_space.size), as rows of
            ``env.get_state()``; one, a sequence, or a mapping from names to them.
        env: An environment of their task.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: One of them is of another task or of another form.
    """
    if isinstance(given, Mapping):
        return [_episode(name, each, env) for name, each in given.items()]
    if isinstance(given, str | Path | Trajectory | torch.Tensor):
        given = [given]
    if not isinstance(given, Sequence):
        raise ValueError(f"episodes must be trajectories, files of them or tensors of states, not {described(given)}")
    return [_episode(None, each, env, i) for i, each in enumerate(given)]


def _episode(name: str | None, given: Any, env: Env, number: int = 0) -> Episode:
    if isinstance(given, str | Path):
        return _of_trajectory(name or Path(given).name, Trajectory.load(given), env)
    if isinstance(given, Trajectory):
        return _of_trajectory(name or f"episode {number}", given, env)
    size = env.state_space.size
    if not isinstance(given, torch.Tensor) or given.ndim != 2 or given.shape[1] != size or not len(given):
        raise ValueError(
            f"an episode of {env.task.name!r} must be a Trajectory, a file of one, or states of shape (steps, {size}) "
            f"as env.get_state() returns them, not {described(given)}"
        )
    unknown = np.full(len(given) - 1, math.nan)
    states = given.detach().to("cpu", torch.float64).numpy().copy()
    return Episode(name or f"episode {number}", states, unknown, unknown)


def _of_trajectory(name: str, trajectory: Trajectory, env: Env) -> Episode:
    check_episode(env, trajectory, name)
    rewards, evals = (values.double().numpy() for values in (trajectory.rewards, trajectory.evals))
    return Episode(name, trajectory.states.numpy(), rewards, evals, trajectory.done_reason)


class Playback:
    """The episode that is played back, and the moment in it.

    Args:
        episodes: The episodes.
    """

    def __init__(self, episodes: Sequence[Episode]) -> None:
        self.episodes = list(episodes)
        self.index, self.step, self.backwards = 0, 0, False

    @property
    def episode(self) -> Episode:
        """The episode that is played back."""
        return self.episodes[self.index]

    @property
    def state(self) -> np.ndarray:
        """The state that is shown, (state_space.size,) float64."""
        return self.episode.states[self.step]

    def choose(self, index: int) -> None:
        """Show another episode, at the same step where it has one.

        Raises:
            ValueError: There is no such episode.
        """
        if not 0 <= index < len(self.episodes):
            raise ValueError(f"there is no episode {index}: there are {len(self.episodes)}, from 0")
        self.index = index
        self.seek(self.step)

    def seek(self, step: int) -> None:
        """Show a step; the first or the last one for a number beyond them."""
        self.step = min(max(step, 0), self.episode.steps)

    def advance(self) -> bool:
        """Show the next step in the direction of the playback; after the last one the first.

        Returns:
            Whether the playback started over.
        """
        step, last = self.step + (-1 if self.backwards else 1), self.episode.steps
        over = not 0 <= step <= last
        self.step = (last if self.backwards else 0) if over else step
        return over

    def around(self, count: int) -> list[int]:
        """At most ``count`` steps at equal distances over the episode, without the one that is shown."""
        last = self.episode.steps
        steps = {round(i * last / max(count - 1, 1)) for i in range(count)}
        return sorted(steps - {self.step})
