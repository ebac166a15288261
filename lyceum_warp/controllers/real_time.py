"""Implement the real-time loop, ``lw.control_async``: the plant steps at a fixed rate while a second thread plans."""

import atexit
import contextlib
import ctypes
import math
import queue
import sys
import threading
import time
import weakref
from typing import TypeAlias

import torch

from lyceum_warp.controllers.checked_controller import CheckedController
from lyceum_warp.controllers.controller import Controller
from lyceum_warp.controllers.episode_collector import EpisodeCollector, OnAbort, OnStep, TimedPlan, begin_episode
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.env.env import Env
from lyceum_warp.support.settings import temporarily
from lyceum_warp.support.validate import check_flag, check_kind, positive_number

# all in seconds
_SPIN = 0.0005  # a wait sleeps until its last 0.5 ms, and then polls the clock
_PATIENCE = 0.2  # timeout for an unfinished plan after an exception
_EXIT_PATIENCE = 5.0  # timeout for an unfinished plan when the program exits
_SWITCH_INTERVAL = 0.0005  # Python's default of 5 ms is too long for plants with a short period

Published: TypeAlias = tuple[int, torch.Tensor, torch.Tensor, torch.Tensor | None]
"""A step's index, the state and the observation before the step, and its action."""


@torch.no_grad()
def control_async(
    env: Env,
    controller: Controller,
    *,
    period: float | None = None,
    steps: int | None = None,
    seed: int | None = None,
    reset: bool = True,
    on_step: OnStep | None = None,
    on_abort: OnAbort | None = None,
    predict: bool = False,
) -> Trajectory:
    """Control one world, the plant, in real time: it steps at a fixed rate and does not wait for plans.

    The plant steps in the calling thread. Step k of the plant is due at ``k * period``. A late step does not delay
    later steps. The controller plans in a second thread, from the newest state, at most once per state.

    Each step applies the action that the newest finished plan has for this time. After the end of the plan, its last
    action is held. The plant waits for the first plan, so the first action has age 0. Later actions are at least one
    step old. If every plan takes less than a period, they are exactly one step old.

    With ``predict``, a copy of the plant predicts the state after the current step, and the controller plans from this
    state. The copy runs no events of the task, such as pushes. Its random numbers differ from the plant's. If planning
    takes less than a period, the plan's first action is applied in the state for which it was planned. Without
    ``predict``, this action comes too late. If the copy's episode ends in the predicted step, the controller plans from
    the measured state.

    Before the clock starts, a warm-up calls the controller three times with the first state, steps the plant three
    times, and restores the plant's state. The warm-up loads kernels and captures graphs, because Warp cannot capture a
    graph while another thread launches kernels. For the same reason, ``on_step`` must not capture graphs. Getters
    with states as arguments, such as ``env.get_reward(before, action, after)``, capture graphs.

    During the run, Python switches between threads more often than usual (``sys.setswitchinterval``). To keep the plant
    on time, put it on the CPU. Leave one CPU core free: reduce ``nthread`` of the planner's environment. A plant on the
    planner's GPU would share a CUDA stream with the planner, so each step would wait for the planner's kernels.

    At the end of the episode, the loop waits for the unfinished plan, and the trajectory includes this plan. If an
    exception, such as Ctrl-C, ends the run, the loop waits at most 0.2 seconds for the unfinished plan. Do not use the
    controller again until the thread, named "lyceum_warp planner", has ended.

    Args:
        env: The plant, an environment of one world made with ``autoreset=False``.
        controller: The controller, called in the second thread; see ``lw.Controller``. The plans must be simulated in a
            separate environment.
        period: Wall time between steps, in seconds; by default the plant's time step, so that the plant runs in real
            time.
        steps: Maximum number of steps; the episode may end earlier.
        seed: Seed of the initial state and of the controller.
        reset: Whether to reset the plant and the controller first. If False, the run continues from the plant's state
            and the controller's last plan.
        on_step: Called with a ``ControlProgress`` after each step, in the calling thread. Slow calls delay the plant.
        on_abort: Called with the trajectory of the complete steps if an exception, such as Ctrl-C, ends the run after
            the first step. The trajectory's ``done_reason`` is 0. The exception is then raised again.
        predict: Whether to plan from predicted states.

    Returns:
        The episode.

    Raises:
        ValueError: The environment has several worlds or automatic resets, or its episode is already over.
        ValueError: The environment has no horizon, and ``steps`` is None.
        ValueError: A number is out of range, or an action has the wrong shape or is not finite.
        Exception: Any exception that the controller raises.
    """
    check_flag("predict", predict)
    check_kind("env", env, Env, "as lw.make(..., autoreset=False) makes it")
    period = positive_number("period", env.timestep if period is None else period, "seconds")
    if period > threading.TIMEOUT_MAX:
        raise ValueError(f"period must be at most {threading.TIMEOUT_MAX:g} seconds, not {period!r}")
    checked, limit, first = begin_episode(env, controller, steps, seed, reset=reset, on_step=on_step, on_abort=on_abort)
    _capture_graphs(env)
    predictor = Predictor(env) if predict else None
    episode = EpisodeCollector(env, checked, mode="async", period=period, seed=seed)
    planner = PlannerThread(checked, seed, first, reset=reset, predictor=predictor)
    with _frequent_thread_switches():
        try:
            planner.publish(0, episode.states[0], episode.obs[0], None)
            planner.wait()
            episode.start = time.perf_counter()
            wall = run_plant(env, checked, planner, Clock(), episode, limit, on_step)
            planner.stop()
            planner.check()
        except BaseException:
            wall = episode.elapsed()
            planner.stop(_PATIENCE)
            planner.add_plans(episode)
            episode.abort(on_abort, wall)
            raise
    planner.add_plans(episode)
    return episode.trajectory(wall, int(env.done_reason.item()))


class Clock:
    """The wall clock, with waits more precise than ``time.sleep``. Tests replace it."""

    def now(self) -> float:
        """Return the seconds since an arbitrary origin, as ``time.perf_counter`` does."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep until shortly before a given moment, and then poll the clock."""
        while (left := moment - self.now()) > _SPIN:
            time.sleep(left - _SPIN)
        while self.now() < moment:
            pass


def run_plant(
    env: Env,
    controller: CheckedController,
    plans: "PlannerThread",
    clock: Clock,
    episode: EpisodeCollector,
    limit: int,
    on_step: OnStep | None,
) -> float:
    """Step the plant at its fixed rate until the episode ends. Return the end of the last period, in seconds."""
    start, period = episode.start, episode.period
    for k in range(limit):
        due = start + k * period
        late = k > 0 and clock.now() > due
        clock.wait_until(due)
        plan = plans.newest()
        env.action[0] = controller.action(plan.actions, k - plan.step)
        now = episode.elapsed()
        # the first action has age 0, because the clock starts after the first plan
        planned_from = episode.times[plan.seen] if plan.seen < k else now
        episode.before_step(plan, now, now - planned_from, late=late)
        if k > 0:
            plans.publish(k, episode.states[k], episode.obs[k], env.action[0].clone())
        env.step()
        episode.after_step(on_step)
        if env.done.item():
            break
    clock.wait_until(start + (k + 1) * period)
    return episode.elapsed()


def _capture_graphs(env: Env) -> None:
    """Step the plant until its graphs are captured, and restore the plant's state."""
    before = env.get_state()
    for _ in range(3):
        env.step()
        env.get_state()
    env.set_state(before)


class Predictor:
    """Predicts the plant's next states, in a copy of the plant.

    As in planners' rollouts, no events run, and the random numbers are not those of the plant.
    """

    def __init__(self, env: Env) -> None:
        self._env = env.replicate()
        worlds, self._key = self._env.worlds, env.state_space.parts["key"]
        self._transition = worlds.programs.graphs.sequence(worlds.transition_phases())
        for _ in range(3):
            self(env.get_state()[0], env.action[0])

    def __call__(self, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Return the next state and its observation, or None if the episode ends.

        Args:
            state: The plant's state, (state_space.size,).
            action: The action applied in this state, (nact,).
        """
        env, start = self._env, state[None].clone()
        start[:, self._key] = (start[:, self._key] + 1) % 2**32  # different keys give independent random numbers
        env.set_state(start)
        env.action[0] = action
        for call in self._transition:
            call()
        return None if env.done.item() else (env.get_state()[0], env.obs[0].clone())


def _frequent_thread_switches() -> contextlib.AbstractContextManager[None]:
    before = sys.getswitchinterval()
    return temporarily(sys.setswitchinterval, min(before, _SWITCH_INTERVAL), before)


class PlannerThread:
    """A thread that calls a controller with the newest published state.

    ``first`` is the number of steps between the reset and the start of the run.
    """

    def __init__(
        self, controller: CheckedController, seed: int | None, first: int, *, reset: bool,
        predictor: Predictor | None = None,
    ) -> None:  # fmt: skip
        self._controller, self._predictor = controller, predictor
        self._seed, self._first, self._reset = seed, first, reset
        self._plans: list[TimedPlan] = []
        self._qualities: dict[int, tuple[float, float]] = {}
        self._error: BaseException | None = None
        self._begun = threading.Event()  # set after the first plan or after an error
        # use SimpleQueue, which is implemented in C, so that no thread loses the GIL while it holds the queue's lock
        self._states: queue.SimpleQueue[Published | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="lyceum_warp planner", daemon=True)
        self._thread.start()

    def publish(self, step: int, state: torch.Tensor, obs: torch.Tensor, action: torch.Tensor | None) -> None:
        """Pass the thread a measured state, and the action that the plant applies in this state.

        The thread starts its next plan from the newest state. The action is None if the plant waits for the plan. The
        caller must not change the tensors.
        """
        self._states.put((step, state, obs, action))

    def wait(self) -> None:
        """Wait for the first plan."""
        self._begun.wait()
        self.check()

    def check(self) -> None:
        """Raise the thread's exception, if there is one."""
        if self._error is not None:
            raise self._error

    def newest(self) -> TimedPlan:
        """Return the newest finished plan."""
        self.check()
        return self._plans[-1]

    def stop(self, patience: float | None = None) -> None:
        """End the thread after its current plan.

        Args:
            patience: Maximum time to wait for the thread, in seconds; None for no limit. If the thread takes longer,
                it continues until its current plan is complete or the program exits.
        """
        self._states.put(None)
        self._thread.join(patience)
        if self._thread.is_alive():
            if not _unfinished:
                atexit.unregister(_interrupt_unfinished)
                atexit.register(_interrupt_unfinished)
            _unfinished.add(self._thread)

    def add_plans(self, episode: EpisodeCollector) -> None:
        """Add the thread's finished plans to an episode."""
        for plan in list(self._plans):
            episode.add_plan(plan, self._qualities.get(plan.index, (math.nan, math.nan)))

    # in the thread

    def _run(self) -> None:
        try:
            with torch.no_grad():  # the calling thread's no_grad has no effect in this thread
                while (published := self._newest_state()) is not None:
                    self._plan(*published)
                    self._begun.set()
        except BaseException as error:
            self._error = error
        finally:
            self._begun.set()

    def _newest_state(self) -> Published | None:
        published = self._states.get()
        while not self._states.empty():
            published = self._states.get()
        return published

    def _plan(self, step: int, state: torch.Tensor, obs: torch.Tensor, action: torch.Tensor | None) -> None:
        controller, last = self._controller, self._plans[-1].step if self._plans else 0
        if not self._plans:
            controller(state, obs, controller.passed(max(self._first - 1, 0), self._first), step)
            controller(state, obs, 0, step)
            if self._reset:
                controller.reset(self._seed)
        begun, ahead = time.perf_counter(), 0
        if self._predictor is not None and action is not None:
            predicted = self._predictor(state, action)
            if predicted is not None:
                (state, obs), ahead = predicted, 1
        start = step + ahead
        actions = controller(state, obs, controller.passed(self._first + last, self._first + start), step)
        plan = TimedPlan(len(self._plans), start, begun, time.perf_counter() - begun, actions, ahead)
        self._plans.append(plan)
        # read the quality after publishing the plan, so that the plant gets the plan sooner
        self._qualities[plan.index] = controller.quality()


_unfinished: "weakref.WeakSet[threading.Thread]" = weakref.WeakSet()


def _interrupt_unfinished() -> None:
    """End planner threads when the program exits, because Python would otherwise free memory that they still use.

    Python raises SystemExit in each thread when the running call of the engine returns. The call takes at most one
    planning iteration.
    """
    for thread in list(_unfinished):
        if thread.is_alive() and thread.ident is not None:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
            thread.join(_EXIT_PATIENCE)
