"""Start an episode of a control loop, collect its steps and plans, and report progress."""

import dataclasses
import time
from collections.abc import Callable

import torch

from lyceum_warp.controllers.checked_controller import CheckedController
from lyceum_warp.controllers.controller import Controller
from lyceum_warp.controllers.trajectory import Trajectory, pictures_of, provenance, stacked
from lyceum_warp.env.env import Env
from lyceum_warp.support.validate import check_flag, check_kind, whole_number


@dataclasses.dataclass(frozen=True)
class ControlProgress:
    """Progress of an episode after a step: the argument of ``on_step``."""

    step: int
    """Number of steps so far."""
    time: float
    """Wall time so far, in seconds."""
    reward: float
    """Reward of the step."""
    eval: float
    """Evaluation metric of the state after the step."""
    success: bool
    """Whether the state after the step is a success."""
    plan_time: float
    """Planning time of the plan that contains the step's action, in seconds."""
    age: float
    """Age of the step's action when it was applied, in seconds; see ``Trajectory.ages``."""
    plans: int
    """Number of plans so far."""


OnStep = Callable[[ControlProgress], object]
OnAbort = Callable[[Trajectory], object]


@dataclasses.dataclass(frozen=True)
class TimedPlan:
    """A finished plan with its planning time."""

    index: int
    step: int  # index of the plan's initial state
    begun: float  # start time, in seconds on the run's clock
    seconds: float
    actions: torch.Tensor  # (horizon, nact)
    ahead: int = 0  # number of steps from the measured state to the predicted initial state

    @property
    def seen(self) -> int:
        """Index of the measured state that the plan is based on."""
        return self.step - self.ahead


def begin_episode(
    env: Env, controller: Controller, steps: int | None, seed: int | None, *, reset: bool, on_step: OnStep | None,
    on_abort: OnAbort | None,
) -> tuple[CheckedController, int, int]:  # fmt: skip
    """Check the arguments that both control loops share. If ``reset`` is set, reset the plant and the controller.

    Returns:
        The controller, the maximum number of steps, and the number of steps since the plant's reset.
    """
    check_kind("env", env, Env, "as lw.make(..., autoreset=False) makes it")
    check_flag("reset", reset)
    check_kind("on_step", on_step, Callable | None, "a function")
    check_kind("on_abort", on_abort, Callable | None, "a function")
    checked = CheckedController(controller, env)
    if env.nworld != 1 or env.autoreset:
        raise ValueError(
            "a control loop needs one world without automatic resets, not "
            f"nworld={env.nworld}, autoreset={env.autoreset}: make(..., nworld=1, autoreset=False)"
        )
    if steps is None and env.horizon == 0:
        raise ValueError(f"an episode of {env.task.name!r} has no time limit: pass steps, or give make() a horizon")
    limit = env.horizon if steps is None else whole_number("steps", steps, low=1)
    if reset:
        env.rand_reset(seed)
        checked.reset(seed)
    elif seed is not None:
        raise ValueError(f"seed={seed} has no effect with reset=False: omit one of the two arguments")
    if env.done.item():
        raise ValueError("the current episode is already over: reset the environment, or omit reset=False")
    return checked, limit, 0 if reset else int(env.episode_step.item())


class EpisodeCollector:
    """Collects the states, actions, outcomes and plans of an episode, and makes a ``Trajectory``."""

    def __init__(
        self, env: Env, controller: CheckedController, *, mode: str, period: float, seed: int | None,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        self.env, self.seed = env, seed
        self.mode, self.period = mode, period
        self.controller = controller.description()
        self.states, self.obs, self.pictures = [env.get_state()[0]], [env.obs[0].clone()], [pictures_of(env)]
        self.times: list[float] = []
        # tuples of action, plan, age, and whether the step was late
        self._applied: list[tuple[torch.Tensor, TimedPlan, float, bool]] = []
        self._outcomes: list[tuple[float, float, bool]] = []
        self._plans: list[tuple[int, float, float, float, float]] = []
        self._now = now
        self.start = now()

    def elapsed(self) -> float:
        """Return the seconds on the clock."""
        return self._now() - self.start

    def add_plan(self, plan: TimedPlan, quality: tuple[float, float]) -> None:
        """Add a finished plan with its number of failed samples and its effective sample size."""
        self._plans.append((plan.seen, plan.begun - self.start, plan.seconds, *quality))

    def before_step(self, plan: TimedPlan, now: float, age: float, *, late: bool) -> None:
        """Record ``env.action``, which the plant is about to apply, and its ``age`` in seconds."""
        self._applied.append((self.env.action[0].clone(), plan, age, late))
        self.times.append(now)

    def after_step(self, on_step: OnStep | None) -> None:
        """Record the result of a step, and report progress."""
        env = self.env
        self.states.append(env.get_state()[0])
        self.obs.append(env.final_obs[0].clone())
        self.pictures.append(pictures_of(env))
        self._outcomes.append((env.reward.item(), env.eval.item(), bool(env.success.item())))
        if on_step is not None:
            step, outcome = len(self._outcomes), self._outcomes[-1]
            plan, age = self._applied[-1][1:3]
            on_step(ControlProgress(step, self.elapsed(), *outcome, plan.seconds, age, plan.index + 1))

    def abort(self, on_abort: OnAbort | None, wall_seconds: float) -> None:
        """Call ``on_abort`` with the trajectory so far, if there are complete steps."""
        if on_abort is not None and self._outcomes and self._plans:
            on_abort(self.trajectory(wall_seconds, done_reason=0))

    def trajectory(self, wall_seconds: float, done_reason: int) -> Trajectory:
        """Return a trajectory with all complete steps."""
        steps = len(self._outcomes)  # an interrupted step has no outcome, so omit it
        rewards, evals, success = zip(*self._outcomes, strict=True)
        actions, plans, ages, late = zip(*self._applied[:steps], strict=True)
        plan_steps, *columns = zip(*self._plans, strict=True)
        times = torch.tensor(columns, dtype=torch.float64)
        return Trajectory(
            states=torch.stack(self.states[: steps + 1]).cpu(), obs=torch.stack(self.obs[: steps + 1]).cpu(),
            actions=torch.stack(actions).cpu(), rewards=torch.tensor(rewards), evals=torch.tensor(evals),
            success=torch.tensor(success), times=torch.tensor(self.times[:steps], dtype=torch.float64),
            ages=torch.tensor(ages, dtype=torch.float64), late=torch.tensor(late),
            plan_of=torch.tensor([plan.index for plan in plans]), plan_steps=torch.tensor(plan_steps),
            plan_starts=times[0], plan_times=times[1], plan_failed=times[2], plan_effective=times[3],
            timestep=self.env.timestep, period=self.period, wall_seconds=wall_seconds, mode=self.mode,
            done_reason=done_reason, seed=self.seed, controller=self.controller,
            pictures=stacked(self.pictures[: steps + 1], 0), **provenance(self.env),
        )  # fmt: skip
