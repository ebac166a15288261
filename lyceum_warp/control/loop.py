"""Controllers at work: in step with the world, or against the clock, with a thread of their own.

A controller is anything that can be called with one world's state, (state_size,) float64, and observation, (nobs,),
and returns an action, (nu,): ``lw.MPPI``, or a policy as ``lambda state, obs: policy(obs)``. Where it has more, that is
used: an argument ``shift``, the number of its steps since the state of its last plan; ``actions``, the whole plan,
(horizon, nu), of which the action is the first; ``timestep``, seconds between the plan's actions; ``reset(seed)``,
called before an episode; ``samples``, how many a plan has, and ``summary``, a mapping that tells of the last plan's
``failed_samples`` and ``effective_samples``; ``settings``, a mapping for the record.
"""

import atexit
import contextlib
import ctypes
import dataclasses
import math
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import torch

from lyceum_warp.control.controller import CheckedController, Controller, seconds_of
from lyceum_warp.control.trajectory import Trajectory, provenance
from lyceum_warp.env import Env
from lyceum_warp.validate import whole_number


@dataclasses.dataclass(frozen=True)
class ControlProgress:
    """Where a run is, after each step; for a live display."""

    step: int
    """Steps so far."""
    time: float
    """Seconds of the wall clock so far, the step included."""
    reward: float
    """Reward of the step."""
    eval: float
    """Evaluation metric of the state that it led to."""
    success: bool
    """Whether the goal is met there."""
    plan_time: float
    """Seconds that the plan took which the action came from."""
    age: float
    """Age of the action when it was applied, seconds."""
    plans: int
    """Plans up to that one, the first included."""


OnStep = Callable[[ControlProgress], object]
OnAbort = Callable[[Trajectory], object]


@torch.no_grad()
def control(
    env: Env,
    controller: Controller,
    *,
    steps: int | None = None,
    seed: int | None = None,
    reset: bool = True,
    on_step: OnStep | None = None,
    on_abort: OnAbort | None = None,
) -> Trajectory:
    """Let a controller run one world that waits for its plans, until the episode ends.

    Args:
        env: The plant: one world, made with ``autoreset=False``.
        controller: What plans; see ``lyceum_warp.control.loop``. It must not step ``env``.
        steps: Steps after which to stop, if the episode has not ended by then.
        seed: Seed of the initial state and of the controller.
        reset: False goes on from where the world and the controller's plan are.
        on_step: Called after each step; the time that it takes counts for none of the plans.
        on_abort: Called with the steps so far, if there are any, when an exception ends the run, Ctrl-C among them; the
            exception then goes on. ``done_reason`` of such a trajectory is 0.

    Returns:
        The episode; its deadline is the plant's time step.

    Raises:
        ValueError: The environment does not fit, the episode is over or would never end, or the controller returns
            what is no action.
    """
    limit = _limit(env, steps)
    plan = CheckedController(controller, env)
    _begin(env, plan, seed, reset)
    clock = _Clock()
    recording = _Recording(env, "sync", env.timestep, plan, seed)
    start = clock.now()
    shift = 0 if reset else 1
    try:
        for k in range(limit):
            begun = clock.now()
            actions = plan(recording.states[k], recording.obs[k], shift, k)
            planned = clock.now()
            env.action[0] = actions[0]
            recording.apply(k, clock.now() - start, clock.now() - begun, late=False)
            recording.plan(_Plan(k, k, begun, planned - begun, actions), start, plan.quality())
            env.step()
            recording.after_step(on_step, clock, start)
            if env.done.item():
                break
            shift = plan.steps(k + 1) - plan.steps(k)
        return recording.trajectory(clock.now() - start, int(env.done_reason.item()))
    except BaseException:
        recording.abort(on_abort, clock.now() - start)
        raise


@torch.no_grad()
def control_async(
    env: Env,
    controller: Controller,
    *,
    period: float | None = None,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int | None = None,
    reset: bool = True,
    on_step: OnStep | None = None,
    on_abort: OnAbort | None = None,
) -> Trajectory:
    """Let a controller run one world that does not wait: it keeps its rate by the wall clock.

    The world steps in the calling thread, step k at ``k * period``; a step that comes late does not put off the
    next ones. The controller plans in a thread of its own, each time from the newest state, and from none twice. Each
    step applies what the newest finished plan has for now: with d simulated seconds since its state, the action
    number ``round(d / timestep)`` of the plan, the last one when it is used up, and the only one of a controller
    without a plan. So the delay of planning is made up for as far as the plan goes, and no action is younger than a
    step but the first: for that one, the plant waits. A controller that is faster than the period has all its other
    actions applied at the age of one step.

    Before the clock starts the controller is called three times with the first state, and the plant takes three
    steps and is put back: kernels are loaded and recordings made then, because a recording of Warp must not be made
    while another thread launches. For the same reason ``on_step`` must not ask for a new ``env.field``, or evaluate
    given states.

    While it runs, Python switches between threads more often than usual (``sys.setswitchinterval``). For a plant
    that is on time, leave it a core: give the planner's environment ``nthread``. The plant belongs on the CPU: on the
    planner's GPU both would share Warp's one stream, where each step waits for the plan before it. The plan that is
    under way when the world stops is completed and counted; when an exception ends the run, Ctrl-C among them, a plan
    that takes longer than a moment is left to its thread, and the controller is of no use until that has ended.

    Args:
        env: The plant: one world, made with ``autoreset=False``.
        controller: What plans, in an environment of its own; see ``lyceum_warp.control.loop``.
        period: Seconds of the wall clock between steps; by default the simulated time step, that is, real time.
        steps: Steps after which to stop, if the episode has not ended by then.
        seconds: Seconds of the wall clock after which to stop, likewise.
        seed: Seed of the initial state and of the controller.
        reset: False goes on from where the world and the controller's plan are.
        on_step: Called after each step in the calling thread: what it takes is the plant's time.
        on_abort: Called with the steps so far, if there are any, when an exception ends the run, Ctrl-C among them; the
            exception then goes on. ``done_reason`` of such a trajectory is 0.

    Returns:
        The episode; its deadline is the period.

    Raises:
        ValueError: The environment does not fit, the episode is over or would never end, a number makes no sense, or
            the controller returns what is no action.
        Exception: Whatever the controller raises.
    """
    period = seconds_of("period", env.timestep if period is None else period)
    if seconds is not None:
        ticks = max(1, math.ceil(seconds_of("seconds", seconds) / period - 1e-9))
        steps = ticks if steps is None else min(whole_number("steps", steps, low=1), ticks)
    limit = _limit(env, steps)
    plan = CheckedController(controller, env)
    _begin(env, plan, seed, reset)
    _warm_up(env)
    recording = _Recording(env, "async", period, plan, seed)
    clock = _Clock()
    planner = _Planner(plan, clock, seed, reset)
    start = clock.now()
    with _quick_switches():
        try:
            planner.publish(0, recording.states[0], recording.obs[0])
            planner.wait()
            start = clock.now()
            wall = _run_plant(env, plan, planner, clock, recording, start, limit, on_step)
            planner.stop()
            planner.check()
        except BaseException:
            wall = clock.now() - start
            planner.stop(_PATIENCE)
            planner.record(recording, start)
            recording.abort(on_abort, wall)
            raise
    planner.record(recording, start)
    return recording.trajectory(wall, int(env.done_reason.item()))


# the clock and the plant

_SPIN = 0.0005  # seconds before its time that a sleep ends; the rest is waited for awake
_PATIENCE = 0.2  # seconds that a plan which nobody wants any more may still take
_LAST_PATIENCE = 5.0  # seconds that it holds up the end of the program at most
_SWITCH_INTERVAL = 0.0005  # seconds; Python's own 5 ms would be most of a fast plant's period


class _Clock:
    """Seconds, and waiting for a moment more precisely than a sleep does."""

    def now(self) -> float:
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        while (left := moment - self.now()) > _SPIN:
            time.sleep(left - _SPIN)
        while self.now() < moment:
            pass


@dataclasses.dataclass(frozen=True)
class _Plan:
    """A finished plan."""

    index: int
    step: int  # whose state it was made from
    begun: float
    seconds: float
    actions: torch.Tensor  # (horizon, nu)


class _Plans(Protocol):
    """Where a plant gets its plans from: a thread, or something simpler in a test."""

    def newest(self) -> _Plan: ...
    def publish(self, step: int, state: torch.Tensor, obs: torch.Tensor) -> None: ...


def _run_plant(
    env: Env,
    controller: CheckedController,
    planner: _Plans,
    clock: _Clock,
    recording: "_Recording",
    start: float,
    limit: int,
    on_step: OnStep | None,
) -> float:
    """Step the plant by the clock; the seconds that it took, to the end of the last step's period."""
    period = recording.period
    for k in range(limit):
        due = start + k * period
        late = k > 0 and clock.now() > due
        clock.wait_until(due)
        plan = planner.newest()
        env.action[0] = plan.actions[controller.index(k - plan.step, len(plan.actions))]
        now = clock.now() - start
        # of the first state, the plan came before the clock started
        recording.newest = plan
        recording.apply(plan.index, now, now - (recording.times[plan.step] if plan.step < k else now), late=late)
        if k > 0:
            planner.publish(k, recording.states[k], recording.obs[k])
        env.step()
        recording.after_step(on_step, clock, start)
        if env.done.item():
            break
    clock.wait_until(start + (k + 1) * period)
    return clock.now() - start


def _warm_up(env: Env) -> None:
    """Let the plant make its recordings, and put it back."""
    before = env.get_state()
    for _ in range(3):
        env.step()
        env.get_state()
    env.set_state(before)


@contextlib.contextmanager
def _quick_switches() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class _Planner:
    """A thread that plans from the newest state that was published."""

    def __init__(self, controller: CheckedController, clock: _Clock, seed: int | None, reset: bool) -> None:
        self.plans: list[_Plan] = []
        self._qualities: list[tuple[float, float]] = []  # of the plans; the last one's may be missing yet
        self._controller, self._clock, self._seed, self._reset = controller, clock, seed, reset
        self._error: BaseException | None = None
        self._begun = threading.Event()  # set by the first plan, or an error
        # written in C: neither side can be put to sleep while it holds a lock that the other one needs
        self._jobs: queue.SimpleQueue[tuple[int, torch.Tensor, torch.Tensor] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="lyceum_warp planner", daemon=True)
        self._thread.start()

    def publish(self, step: int, state: torch.Tensor, obs: torch.Tensor) -> None:
        """Have the next plan made from a state; it is a copy, and stays as it is."""
        self._jobs.put((step, state, obs))

    def wait(self) -> None:
        """Wait for the first plan."""
        self._begun.wait()
        self.check()

    def check(self) -> None:
        """Raise what was raised in the thread."""
        if self._error is not None:
            raise self._error

    def newest(self) -> _Plan:
        self.check()
        return self.plans[-1]

    def stop(self, patience: float | None = None) -> None:
        """End the thread, with the plan that it is at; don't wait for that one longer than so many seconds.

        A plan that takes longer is left to itself, and the thread ends after it.
        """
        self._jobs.put(None)
        self._thread.join(patience)
        if self._thread.is_alive():
            atexit.register(_end, self._thread)

    def record(self, recording: "_Recording", start: float) -> None:
        """Note the plans that are finished."""
        qualities = list(self._qualities)
        plans = self.plans[: len(qualities) + 1]  # those that have one, and the one that may be about to get it
        qualities += [(math.nan, math.nan)] * (len(plans) - len(qualities))
        for plan, quality in zip(plans, qualities, strict=True):
            recording.plan(plan, start, quality)

    def _newest_job(self) -> tuple[int, torch.Tensor, torch.Tensor] | None:
        job = self._jobs.get()
        while not self._jobs.empty():
            job = self._jobs.get()
        return job

    def _work(self) -> None:
        try:
            with torch.no_grad():  # holds for a thread only
                last = 0
                while (job := self._newest_job()) is not None:
                    self._plan(*job, last)
                    last = job[0]
                    self._begun.set()
        except BaseException as error:
            self._error = error
        finally:
            self._begun.set()

    def _plan(self, step: int, state: torch.Tensor, obs: torch.Tensor, last: int) -> None:
        controller = self._controller
        if not self.plans:
            controller(state, obs, 0 if self._reset else 1, step)
            controller(state, obs, 0, step)
            if self._reset:
                controller.reset(self._seed)
        begun = self._clock.now()
        actions = controller(state, obs, controller.steps(step) - controller.steps(last), step)
        self.plans.append(_Plan(len(self.plans), step, begun, self._clock.now() - begun, actions))
        self._qualities.append(controller.quality())  # after the plant has got its actions


def _end(thread: threading.Thread) -> None:
    """Stop a planner's thread, because the program ends.

    Python would take away the memory that the engine is computing on, and crash. An exception in the thread ends the
    plan when the engine's call is done, which is an improvement of the plan, not all of it.
    """
    if thread.is_alive() and thread.ident is not None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
        thread.join(_LAST_PATIENCE)


# what both ways share


class _Recording:
    """A trajectory in the making."""

    def __init__(self, env: Env, mode: str, period: float, controller: CheckedController, seed: int | None) -> None:
        self.env, self.mode, self.period, self.seed = env, mode, period, seed
        self.controller = controller.description()
        self.states, self.obs = [env.get_state()[0]], [env.obs[0].clone()]
        self.actions: list[torch.Tensor] = []
        self.outcomes: list[tuple[float, float, bool]] = []
        self.times: list[float] = []
        self.ages: list[float] = []
        self.late: list[bool] = []
        self.plan_of: list[int] = []
        self.plans: list[tuple[int, float, float, float, float]] = []
        self.newest: _Plan | None = None

    def plan(self, plan: _Plan, start: float, quality: tuple[float, float]) -> None:
        """Note a plan, and how good its samples were."""
        self.newest = plan
        self.plans.append((plan.step, plan.begun - start, plan.seconds, *quality))

    def apply(self, plan: int, now: float, age: float, *, late: bool) -> None:
        """Note the action that is about to be applied."""
        self.actions.append(self.env.action[0].clone())
        self.times.append(now)
        self.ages.append(age)
        self.late.append(late)
        self.plan_of.append(plan)

    def after_step(self, on_step: OnStep | None, clock: _Clock, start: float) -> None:
        """Note what a step led to."""
        env = self.env
        self.states.append(env.get_state()[0])
        self.obs.append(env.final_obs[0].clone())
        self.outcomes.append((env.reward.item(), env.eval.item(), bool(env.success.item())))
        if on_step is not None:
            assert self.newest is not None
            at, plan_time, now = len(self.outcomes), self.newest.seconds, clock.now() - start
            on_step(ControlProgress(at, now, *self.outcomes[-1], plan_time, self.ages[-1], self.newest.index + 1))

    def abort(self, on_abort: OnAbort | None, wall: float) -> None:
        """Hand out the steps so far, if there are any."""
        if on_abort is not None and self.outcomes and self.plans:
            on_abort(self.trajectory(wall, 0))

    def trajectory(self, wall: float, done_reason: int) -> Trajectory:
        """All of it; of a step that was interrupted, nothing."""
        steps = len(self.outcomes)  # they are noted last
        rewards, evals, success = zip(*self.outcomes, strict=True)
        plan_steps, *plans = zip(*self.plans, strict=True)
        plan_starts, plan_times, failed, effective = (torch.tensor(column, dtype=torch.float64) for column in plans)
        times, ages = (torch.tensor(column[:steps], dtype=torch.float64) for column in (self.times, self.ages))
        return Trajectory(
            states=torch.stack(self.states[: steps + 1]).cpu(), obs=torch.stack(self.obs[: steps + 1]).cpu(),
            actions=torch.stack(self.actions[:steps]).cpu(), rewards=torch.tensor(rewards), evals=torch.tensor(evals),
            success=torch.tensor(success), times=times, ages=ages, late=torch.tensor(self.late[:steps]),
            plan_of=torch.tensor(self.plan_of[:steps]), plan_steps=torch.tensor(plan_steps), plan_starts=plan_starts,
            plan_times=plan_times, plan_failed=failed, plan_effective=effective, timestep=self.env.timestep,
            period=self.period, wall_seconds=wall, mode=self.mode, done_reason=done_reason, seed=self.seed,
            controller=self.controller, **provenance(self.env),
        )  # fmt: skip


def _limit(env: Env, steps: int | None) -> int:
    """The number of steps after which to stop."""
    if env.nworld != 1 or env.autoreset:
        raise ValueError("a controller runs one world without automatic resets: make(..., nworld=1, autoreset=False)")
    if steps is not None:
        return whole_number("steps", steps, low=1)
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} may never end without a horizon: give steps, or a horizon")
    return env.horizon


def _begin(env: Env, controller: CheckedController, seed: int | None, reset: bool) -> None:
    if reset:
        env.rand_reset(seed)
        controller.reset(seed)
    elif seed is not None:
        raise ValueError("a seed needs a reset: leave out one of them")
    if env.done.item():
        raise ValueError("the episode is over before its first step: reset the environment, or let reset=True do it")
