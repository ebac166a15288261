"""Measure how fast a planner with coarser physics is, and how well it ranks samples."""

import statistics
import time
from typing import Any

import numpy as np
import torch

from lyceum_warp.algos import MPPI
from lyceum_warp.core import PhysicsOptions, Task
from lyceum_warp.support.intervals import mean_interval
from lyceum_warp.tuning.candidates import Setting
from lyceum_warp.tuning.trial import random_actions

_SAMPLES = 64
_MOVING_STEPS = (30, 120)
_FALLING_STEPS, _LYING_STEPS = 200, 10
_REPLAN_EVERY = 6
_IMPROVEMENTS = 2
"""How often the planner updates a plan. The compared samples are then drawn around the updated plan."""


class Rankings:
    """Compares a planner's physics options with the plant's options.

    From each state, both planners draw the same samples around the same plan. The rank correlation of the samples'
    returns shows whether coarser physics is good enough. A planner uses only the order and the differences of returns.
    There are three kinds of states:

    - standing: after a random reset;
    - moving: after steps under a planner that uses the plant's physics and replans every 6 steps. The number of steps
      is spread evenly from 30 to 120, because grasps happen late in an episode;
    - fallen: after random actions. These continue until all episodes have ended, for at most 200 steps. Ten more steps
      follow.
    """

    def __init__(
        self, task: type[Task], *, states: int, repeats: int, samples: int = _SAMPLES, seed: int = 0, **options: Any
    ) -> None:
        self.task, self.seed = task, seed
        self.states, self.repeats = states, repeats
        # with several iterations, each planner would adapt its samples to its own physics
        self.options = {"iterations": 1, "seed": seed, "samples": samples, **options}
        self.exact, self.one = self._planner({}, states), self._planner({}, 1)
        self.reference = self.exact.env
        self.starts = self._find_states()
        self._exact = {kind: self._prepared(start) for kind, start in self.starts.items()}

    def _planner(self, physics: Any, plants: int) -> MPPI:
        return MPPI(self.task, physics=PhysicsOptions(**physics), plants=plants, **self.options)

    def _find_states(self) -> dict[str, torch.Tensor]:
        plant = self.reference.replicate(nworld=self.states, autoreset=False)
        plant.rand_reset(self.seed)
        standing = plant.get_state()
        self.exact.reset(self.seed)
        every = min(_REPLAN_EVERY, self.exact.horizon)
        moving, counts = standing.clone(), torch.linspace(*_MOVING_STEPS, self.states).round()
        for step in range(int(counts.max())):
            if step % every == 0:
                self.exact(plant.get_state(), shift=every if step else 0)
            plant.step(self.exact.actions[step % every].reshape(plant.action.shape))
            if (due := counts == step + 1).any():
                moving[due] = plant.get_state()[due]
        plant.rand_reset(self.seed + 1)
        draw, fallen = random_actions(plant, self.seed), torch.zeros_like(plant.done)
        for _ in range(_FALLING_STEPS):
            plant.step(next(draw))
            fallen |= plant.done
            if fallen.all():
                break
        for _ in range(_LYING_STEPS):
            plant.step(next(draw))
        return {"standing": standing, "moving": moving, "fallen": plant.get_state()}

    def _prepared(self, start: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a plan for each state, and the returns of the samples around each plan, (states, samples)."""
        self.exact.reset(self.seed)
        for _ in range(_IMPROVEMENTS):
            self.exact(start, shift=0)
        plan = self.exact.knot_actions.clone()
        return plan, self._returns(self.exact, start, plan)

    def _returns(self, planner: MPPI, start: torch.Tensor, plan: torch.Tensor) -> torch.Tensor:
        planner.reset(self.seed + 1)
        planner.knot_actions.copy_(plan)
        planner(start, shift=0)
        return planner.returns.reshape(self.states, -1).clone()

    def measure(self, setting: Setting) -> dict[str, Any]:
        """Measure a setting, and return its row of results."""
        row: dict[str, Any] = {"name": setting.name, "physics": dict(setting.physics), "refused": ""}
        try:
            planner, one = self._planner(setting.physics, self.states), self._planner(setting.physics, 1)
        except ValueError as error:
            return row | {"refused": str(error)}
        times, ratios = [], []
        start = self.starts["moving"][0]
        for repeat in range(self.repeats + 1):
            exact, coarse = self._seconds(self.one, start), self._seconds(one, start)
            if repeat:  # the first plans are not timed, because they load kernels
                times.append(coarse)
                ratios.append(exact / coarse)
        row |= {"plan_ms": 1e3 * statistics.median(times), "speedup": statistics.median(ratios), "ranks": {}}
        for kind, (plan, returns) in self._exact.items():
            correlations = rank_correlations(returns, self._returns(planner, self.starts[kind], plan))
            if len(correlations):
                mean, half = mean_interval(correlations)
                row["ranks"][kind] = {"mean": mean, "low": max(mean - half, -1.0), "high": min(mean + half, 1.0)}
        return row

    def _seconds(self, planner: MPPI, start: torch.Tensor) -> float:
        begin = time.perf_counter()
        planner(start)
        if planner.actions.is_cuda:
            torch.cuda.synchronize(planner.actions.device)
        return time.perf_counter() - begin


def rank_correlations(first: torch.Tensor, second: torch.Tensor) -> np.ndarray:
    """Compute Spearman's rank correlation of two arrays, (rows, n), row by row.

    A row is left out if all of its numbers in ``first`` are equal.
    """
    a, b = _centred_ranks(first.double()), _centred_ranks(second.double())
    varies = a.square().sum(1) > 0
    spread = a.square().sum(1) * b.square().sum(1)
    correlations = torch.where(spread > 0, (a * b).sum(1) / spread.clamp_min(1e-300).sqrt(), 0.0)
    return correlations[varies].cpu().numpy()


def _centred_ranks(values: torch.Tensor) -> torch.Tensor:
    less = values[:, :, None] > values[:, None, :]
    equal = values[:, :, None] == values[:, None, :]
    ranks = less.sum(2) + equal.sum(2) / 2
    return ranks - ranks.mean(1, keepdim=True)
