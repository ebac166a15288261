"""Run the plant, the copy of the shown world that a controller of one world controls in real time."""

import threading
import time
from collections.abc import Callable

from lyceum_warp.controllers.episode_collector import ControlProgress
from lyceum_warp.controllers.real_time import Clock, control_async
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.engines.placement import options_for_plant
from lyceum_warp.viewer.session.drivers import ControllerError, WorldControl
from lyceum_warp.viewer.session.live import PLANT_HISTORY_BYTES, Live

POLL = 0.005
"""Seconds between two looks at the window's commands."""

_RESERVE = 0.0015  # seconds before a plant's step in which the session does not begin any work
_PART = 10_000  # steps of a plant in one run of the loop, which keeps all of their states
_WARM_UP = 3  # calls of a controller in which it may capture graphs, which must not happen beside other work


class InterruptedByCommand(BaseException):
    """Ends a run of the plant, because a command needs its state."""


def make_plant(main: Live) -> Live:
    """One world for controllers of one world, on the CPU, where its steps do not wait for a planner's GPU."""
    env, plant = main.env, main
    if env.nworld > 1 or env.autoreset or env.device.is_cuda:
        options = options_for_plant(env.options.engine, env.device)
        if options.get("engine", env.engine.name) == "mujoco":
            options["nthread"] = 1
        plant = Live(env.replicate(nworld=1, autoreset=False, **options), limit=PLANT_HISTORY_BYTES)
        main.warm_up()
    plant.warm_up()
    return plant


def run_plant(
    live: Live,
    control: WorldControl,
    *,
    speed: float,
    work: Callable[[], None],
    on_step: Callable[[ControlProgress], None],
    on_trajectory: Callable[[Trajectory], object] | None,
) -> None:
    """Control the plant by the clock until its episode ends.

    Args:
        live: The plant.
        control: Its controller.
        speed: Simulated seconds per second.
        work: Called while the plant waits for its next step. It ends the run with ``InterruptedByCommand``.
        on_step: Called after each step.
        on_trajectory: Called with the steps of the run, also of one that is interrupted.

    Raises:
        ControllerError: The controller raised an exception, or its actions do not fit.
    """
    live.expect_steps()
    try:
        trajectory = control_async(
            live.env, control.new_run(), period=live.env.timestep / speed, steps=_PART, reset=False, on_step=on_step,
            on_abort=on_trajectory, clock=_WorkingClock(work, warm=control.calls >= _WARM_UP),
        )  # fmt: skip
        if on_trajectory is not None:
            on_trajectory(trajectory)
    except InterruptedByCommand:
        pass
    except ValueError as error:  # of actions that do not fit
        raise ControllerError(control.name, error) from error
    finally:
        control.end_run()


class _WorkingClock(Clock):
    """The wall clock; while a plant waits for its next step, its session works.

    Args:
        work: The work of the session.
        warm: Whether to work while the plant waits for the first plan, too.
    """

    def __init__(self, work: Callable[[], None], *, warm: bool) -> None:
        self._work, self._warm = work, warm

    def wait_until(self, moment: float) -> None:
        end = moment - _RESERVE
        while (now := time.perf_counter()) < end:
            self._work()
            left = min(end, now + POLL) - time.perf_counter()
            if left > 0:
                time.sleep(left)
        super().wait_until(moment)

    def wait_for(self, event: threading.Event) -> None:
        if not self._warm:
            event.wait()
        while not event.wait(POLL):
            self._work()
