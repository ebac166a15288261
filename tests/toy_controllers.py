"""Define controllers for tests, and a planner on a simulated clock."""

import math
import time
from typing import Any

import torch

import lyceum_warp as lw
from lyceum_warp.controllers import CheckedController, ControlProgress, Trajectory
from lyceum_warp.controllers.episode_collector import EpisodeCollector, TimedPlan
from lyceum_warp.controllers.real_time import run_plant


def towards(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
    x, y, vx, vy, tx, ty = obs
    return torch.stack([2 * (tx - x) - vx, 2 * (ty - y) - vy]).clamp(-1, 1)


class StepPlanner:
    """A planner whose actions encode the step of the plan and the index of the action.

    Both numbers are divided by 100. ``hundredths`` converts the actions back.
    """

    def __init__(self, env: lw.Env, horizon: int = 8, seconds: float = 0.0) -> None:
        self.timestep = env.timestep
        self.actions = torch.zeros(horizon, 2)
        self.seconds = seconds
        self.column = env.state_space.parts["step"].start
        self.shifts: list[int] = []
        self.resets: list[int | None] = []

    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None, *, shift: int = 1) -> torch.Tensor:
        assert not torch.is_grad_enabled()
        self.shifts.append(shift)
        time.sleep(self.seconds)
        self.actions[:, 0] = state[self.column].float() / 100
        self.actions[:, 1] = torch.arange(len(self.actions)) / 100
        return self.actions[0].clone()

    def reset(self, seed: int | None = None) -> None:
        self.resets.append(seed)


def hundredths(values: torch.Tensor) -> list[int]:
    return (100 * values).round().int().tolist()


class SamplingPlanner:
    def __init__(self, *failed: float) -> None:
        self.samples, self.failed, self.calls = 8, failed, 0
        self.actions = torch.zeros(4, 2)
        self.settings = {"samples": 8, "odd": object(), "smoothing": (1.0, 0.0)}

    def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> object:
        self.calls += 1
        return object()  # the loops must read ``actions`` and ignore this attribute

    def reset(self, seed: int | None = None) -> None:
        self.calls = 0

    @property
    def summary(self) -> dict[str, float]:
        failed = self.failed[min(self.calls, len(self.failed)) - 1]
        return {"failed_samples": failed, "effective_samples": math.nan if failed == 8 else 2.0}


class SimulatedClock:
    """A clock that advances only when a test sets it or the loop waits."""

    def __init__(self) -> None:
        self.time = 100.0

    def now(self) -> float:
        return self.time

    def wait_until(self, moment: float) -> None:
        self.time = max(self.time, moment)


class SimulatedPlans:
    """A planner on the simulated clock. Each plan takes a fixed time and starts from the newest state."""

    def __init__(
        self, controller: Any, clock: SimulatedClock, seconds: float, first: tuple[torch.Tensor, torch.Tensor]
    ) -> None:
        self.controller, self.clock, self.seconds = controller, clock, seconds
        actions = controller(*first, 0, 0)
        self.plans = [TimedPlan(0, 0, clock.time - seconds, seconds, actions)]
        self.running: TimedPlan | None = None
        self.waiting: tuple[int, torch.Tensor, torch.Tensor] | None = None

    def begin(self, now: float, step: int, state: torch.Tensor, obs: torch.Tensor) -> None:
        self.running = TimedPlan(len(self.plans), step, now, self.seconds, self.controller(state, obs, 1, step))

    def newest(self) -> TimedPlan:
        while self.running is not None and (end := self.running.begun + self.seconds) <= self.clock.time + 1e-9:
            self.plans.append(self.running)
            self.running = None
            if self.waiting is not None:
                self.begin(end, *self.waiting)
                self.waiting = None
        return self.plans[-1]

    def publish(self, step: int, state: torch.Tensor, obs: torch.Tensor, action: torch.Tensor) -> None:
        published = step, state, obs
        self.waiting = published
        if self.running is None:
            self.begin(self.clock.time, *published)
            self.waiting = None


def simulated_run(
    env: lw.Env, *, seconds: float, steps: int, horizon: int = 8, busy: dict[int, float] | None = None
) -> Trajectory:
    """Run the asynchronous loop on the simulated clock.

    Times are in seconds, and the period is one second. ``busy`` maps the index of a step to its duration.
    """
    env.rand_reset(0)
    clock = SimulatedClock()
    controller = CheckedController(StepPlanner(env, horizon), env)
    episode = EpisodeCollector(env, controller, mode="async", period=1.0, seed=None, now=clock.now)

    def on_step(progress: ControlProgress) -> None:
        clock.time += (busy or {}).get(progress.step - 1, 0.0)

    with torch.no_grad():
        plans = SimulatedPlans(controller, clock, seconds, (episode.states[0], episode.obs[0]))
        wall = run_plant(env, controller, plans, clock, episode, steps, on_step)  # type: ignore[arg-type]
    for plan in plans.plans:
        episode.add_plan(plan, (math.nan, math.nan))
    return episode.trajectory(wall, 0)
