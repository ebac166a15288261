"""Run a controller of one world in real time, in a copy of the displayed world."""

import threading
import time
from collections.abc import Callable

from lyceum_warp.controllers.episode_collector import ControlProgress
from lyceum_warp.controllers.real_time import Clock, control_async
from lyceum_warp.engines.placement import options_for_plant
from lyceum_warp.viewer.session.drivers import ControllerError, WorldControl
from lyceum_warp.viewer.session.live import PLANT_HISTORY_BYTES, Live

POLL = 0.005
"""Seconds between two polls of the window's commands."""

_RESERVE = 0.0015  # seconds before a step in which no other work may start
_PART = 10_000  # maximum steps of one control loop, which stores all its states
_WARM_UP = 3  # the first calls may capture CUDA graphs, so no other work runs during them


class InterruptedByCommand(BaseException):
    """Stops the plant because a command of the user needs its state."""


def make_plant(main: Live) -> Live:
    """Make the plant: a single world on the CPU, where steps do not wait for a planner's GPU."""
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
) -> None:
    """Run the plant in real time until its episode ends.

    Args:
        live: The plant.
        control: The plant's controller.
        speed: Simulated seconds per second.
        work: Called while the plant waits for its next step. It may raise ``InterruptedByCommand`` to stop the plant.
        on_step: Called after each step.
    """
    live.expect_steps()
    try:
        control_async(
            live.env, control.new_run(), period=live.env.timestep / speed, steps=_PART, reset=False, on_step=on_step,
            clock=_WorkingClock(work, warm=control.calls >= _WARM_UP),
        )  # fmt: skip
    except InterruptedByCommand:
        pass
    except ValueError as error:  # from invalid actions
        raise ControllerError(control.name, error) from error
    finally:
        control.new_run()  # calls from this control loop now fail


class _WorkingClock(Clock):
    """A wall clock that calls ``work`` while it waits."""

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
