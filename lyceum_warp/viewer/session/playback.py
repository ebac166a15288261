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


def episodes_of(episodes: Any, env: Env) -> list[Episode]:
    """Load the episodes to play back."""
    if isinstance(episodes, str | Path | Trajectory | torch.Tensor):
        episodes = [episodes]
    if isinstance(episodes, Mapping):
        return [_episode(name, episode, env) for name, episode in episodes.items()]
    if not isinstance(episodes, Sequence):
        raise ValueError(
            "episodes must be a list or a dict of trajectories, episode files or state tensors, "
            f"not {described(episodes)}"
        )
    return [
        _episode(Path(episode).name if isinstance(episode, str | Path) else f"episode {i}", episode, env)
        for i, episode in enumerate(episodes)
    ]


def _episode(name: str, episode: Any, env: Env) -> Episode:
    if isinstance(episode, str | Path):
        episode = Trajectory.load(episode)
    if isinstance(episode, Trajectory):
        check_episode(env, episode, name)
        end = "success" if episode.steps and episode.succeeded else reasons(episode.done_reason)
        rewards, evals = episode.rewards.double().numpy(), episode.evals.double().numpy()
        return Episode(name, episode.states.numpy(), rewards, evals, end)
    size = env.state_space.size
    if not isinstance(episode, torch.Tensor) or episode.ndim != 2 or episode.shape[1] != size or not len(episode):
        raise ValueError(
            f"an episode of {env.task.name!r} must be a Trajectory, a file of a Trajectory, or states of shape (steps, "
            f"{size}) as env.get_state() returns them, not {described(episode)}"
        )
    unknown = np.full(len(episode) - 1, np.nan)
    states = episode.detach().to("cpu", torch.float64).numpy().copy()
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
