"""Compare a physics setting with the unchanged task: speed, memory, faults and returns."""

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos import ENDLESS_STEPS, action_bounds
from lyceum_warp.core import FAULTS
from lyceum_warp.env import Env, Player, Policy
from lyceum_warp.tuning.candidates import Setting
from lyceum_warp.tuning.judgement import TOLERANCES, buys, difference, episodes_needed, failures

_ACTIONS = 50
"""Number of recorded actions that follow each recorded state."""
_HALF_WIDTHS = {"returns": TOLERANCES["strict"] / 2, "clearly_worse": TOLERANCES["strict"]}
"""Target half-widths of the confidence intervals. They determine the number of episodes."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """Limits on the duration of measurements."""

    repeats: int
    """Number of timed blocks of steps. Each block runs with the unchanged task and with the setting."""
    block_seconds: float
    judging_seconds: float
    """Time limit for the unchanged task's episodes. It applies separately to random actions and to the policy."""
    steps: int
    """Maximum number of steps in an episode, or 0 for the task's horizon."""
    recorded_at: tuple[int, ...]
    """States are recorded after these numbers of steps. Speed is measured from the recorded states."""


FULL = Effort(repeats=15, block_seconds=0.3, judging_seconds=60.0, steps=0, recorded_at=(5, 20, 50, 100))
SHORT = Effort(repeats=7, block_seconds=0.1, judging_seconds=5.0, steps=100, recorded_at=(30,))


class Trials:
    """Compares settings with the unchanged task. Both run alternately in one process.

    Args:
        reference: The unchanged task, made with ``autoreset=False``.
    """

    def __init__(
        self, reference: Env, policy: Policy | None, *, effort: Effort, seed: int = 0, episodes: int | None = None
    ) -> None:
        self.reference, self.player = reference, None if policy is None else Player(policy, reference)
        self.effort, self.seed = effort, seed
        self.batches = None if episodes is None else math.ceil(episodes / reference.nworld)
        # failures that end episodes change the returns of many episodes, so the mean return shows them
        self.judges = {"returns": difference}
        if not reference.task.ends_by("terminated"):
            self.judges["clearly_worse"] = failures
        self.sources = {"random": None} | ({} if policy is None else {"policy": policy})
        self.steps = effort.steps or reference.horizon or ENDLESS_STEPS
        if reference.horizon:
            self.steps = min(self.steps, reference.horizon)
        self._returns: dict[tuple[str, int], tuple[np.ndarray, int, int]] = {}
        self._batch_seconds: dict[str, float] = {}
        self._record()

    # recorded states and actions

    def _record(self) -> None:
        """Record states. Half of the worlds follow the policy, and the others act at random."""
        env, draw = self.reference, random_actions(self.reference, self.seed)
        policy_worlds = torch.arange(env.nworld, device=env.obs.device)[:, None] % 2 == 1
        self._starts: list[torch.Tensor] = []
        self._actions: list[torch.Tensor] = []
        memories = []
        env.rand_reset(self.seed)
        for step in range(max(self.effort.recorded_at) + 1):
            if step in self.effort.recorded_at:
                self._starts.append(env.get_state())
                memories.append(None if self.player is None else self.player.state.clone())
            env.rand_reset(mask=env.done)
            env.step(self._mixed(next(draw), policy_worlds))
        for start, memory in zip(self._starts, memories, strict=True):
            env.set_state(start)
            if self.player is not None and memory is not None:
                self.player.state.copy_(memory)
            actions = []
            for _ in range(_ACTIONS):
                actions.append(self._mixed(next(draw), policy_worlds))
                env.step(actions[-1])
            self._actions.append(torch.stack(actions))
        self._block = 1
        self._block = max(1, round(self.effort.block_seconds / self._seconds(env, 0)))

    def _mixed(self, random: torch.Tensor, policy_worlds: torch.Tensor) -> torch.Tensor:
        if self.player is None:
            return random
        return torch.where(policy_worlds, self.player(self.reference.obs), random)

    # one setting

    def measure(self, setting: Setting) -> dict[str, Any]:
        """Return a row of results. Returns are compared only if the setting saves time or memory."""
        row: dict[str, Any] = {"name": setting.name, "physics": dict(setting.physics), "refused": ""}
        try:
            env = self.reference.replicate(autoreset=False, **setting.physics)
        except ValueError as error:
            return row | {"refused": str(error)}
        speed, speedup, low = self._speed(env)
        row |= {"steps_per_second": speed, "speedup": speedup, "speedup_low": low}
        row |= {"bytes_per_world": env.bytes_per_world}
        row["memory"] = env.bytes_per_world / self.reference.bytes_per_world
        row |= {name: {} for name in self.judges}
        faults, steps = np.zeros(2), np.zeros(2)
        if not setting.physics or buys(low, row["memory"]):
            for source in self.sources:
                pairs, *counts = self._compare(env, source)
                for name, judge in self.judges.items():
                    row[name][source] = dataclasses.asdict(judge(*pairs))
                faults, steps = faults + counts[0], steps + counts[1]
        rates = 1e6 * faults / np.maximum(steps, 1)
        row |= {"faults_per_million": rates[0], "reference_faults_per_million": rates[1]}
        return row

    def _speed(self, env: Env) -> tuple[float, float, float]:
        """Measure steps per second, summed over the worlds, and the speed-up over the unchanged task.

        The speed-up is returned as a median over blocks and as a lower bound. The lower bound is the smaller of two
        numbers: the blocks' lower quartile, and the speed-up between the fastest blocks. It is cautious, because other
        processes may slow down single blocks.
        """
        count = self._block * env.nworld
        starts = [repeat % len(self._starts) for repeat in range(self.effort.repeats)]
        times = np.array([(self._seconds(self.reference, k), self._seconds(env, k)) for k in starts])
        exact, changed = times.T
        low = min(np.quantile(exact / changed, 0.25), exact.min() / changed.min())
        return count / float(np.median(changed)), float(np.median(exact / changed)), float(low)

    def _seconds(self, env: Env, k: int) -> float:
        actions = self._actions[k]
        env.set_state(self._starts[k])
        env.step(actions[0])
        wp.synchronize_device(env.device)
        start = time.perf_counter()
        for step in range(self._block):
            env.step(actions[step % len(actions)])
        wp.synchronize_device(env.device)
        return time.perf_counter() - start

    def _compare(self, env: Env, source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Get pairs of returns, (2, episodes), and count faults and steps with and without the setting.

        The spread in the first batch determines the number of batches.
        """
        pairs: list[np.ndarray] = []
        faults, steps = np.zeros(2), np.zeros(2)
        batches = self.batches or 1
        while len(pairs) < batches:
            batch = len(pairs)
            if (source, batch) not in self._returns:
                start = time.perf_counter()
                self._returns[source, batch] = self._episodes(self.reference, source, batch)
                self._batch_seconds[source] = time.perf_counter() - start
            changed, exact = self._episodes(env, source, batch), self._returns[source, batch]
            pairs.append(np.stack([exact[0], changed[0]]))
            faults += (changed[1], exact[1])
            steps += (changed[2], exact[2])
            if batch == 0 and self.batches is None:
                first = {name: judge(*pairs[0]) for name, judge in self.judges.items()}
                if not any(difference.beyond(TOLERANCES["loose"]) for difference in first.values()):
                    most = max(1, int(self.effort.judging_seconds / self._batch_seconds[source]))
                    needed = max(episodes_needed(first[name], _HALF_WIDTHS[name]) for name in first)
                    batches = min(most, math.ceil(needed / env.nworld))
        return np.concatenate(pairs, axis=1), faults, steps

    def _episodes(self, env: Env, source: str, batch: int) -> tuple[np.ndarray, int, int]:
        """Run one episode per world, and get the episodes' returns (nworld,), the faults and the steps.

        The batch number determines the initial states, the random streams and the random actions.
        """
        seed = self.seed + 1 + batch
        self.reference.rand_reset(seed)
        if env is not self.reference:
            env.set_state(self.reference.get_state())
        draw, policy = random_actions(env, seed), self.sources[source]
        player = None if policy is None else Player(policy, env)
        total = torch.zeros(env.nworld, dtype=torch.float64, device=env.obs.device)
        alive = torch.ones(env.nworld, dtype=torch.bool, device=env.obs.device)
        faults = torch.zeros((), dtype=torch.int64, device=env.obs.device)
        steps = torch.zeros_like(faults)
        for step in range(self.steps):
            env.step(next(draw) if player is None else player(env.obs))
            total += torch.where(alive, env.reward, 0.0)
            steps += alive.sum()
            faults += (alive & (env.done_reason & int(FAULTS) != 0)).sum()
            alive &= ~env.done
            if step % 10 == 9 and not alive.any():
                break
        return total.cpu().numpy(), int(faults), int(steps)


def random_actions(env: Env, seed: int) -> Iterator[torch.Tensor]:
    """Yield uniform random actions, (nworld, nact). Infinite bounds are replaced by -1 and 1."""
    device = env.obs.device
    generator = torch.Generator(device).manual_seed(seed)
    start, end = torch.tensor(action_bounds(env, limit=1.0), device=device)
    size = end - start
    while True:
        yield start + size * torch.rand(env.action.shape, generator=generator, device=device)
