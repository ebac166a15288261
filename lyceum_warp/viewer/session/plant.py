"""Make the plant as a copy of the displayed world, and make the clock of the control loop."""

import threading
import time
from collections.abc import Callable

from lyceum_warp.controllers.real_time import Clock
from lyceum_warp.engines.placement import options_for_plant
from lyceum_warp.viewer.session.drivers import WorldControl
from lyceum_warp.viewer.session.live import PLANT_HISTORY_BYTES, Live

POLL = 0.005
"""Seconds between two polls of the window's commands."""

_RESERVE = 0.0015  # minimum time between the start of other work and a step, in seconds
_WARM_UP = 3  # number of first calls during which no other work runs, because they may capture CUDA graphs


class InterruptedByCommand(BaseException):
    """Raised to stop the plant, because a command needs its state."""


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


class WorkingClock(Clock):
    """A wall clock that calls ``work`` while it waits."""

    def __init__(self, work: Callable[[], None], control: WorldControl) -> None:
        self._work, self._warm = work, control.calls >= _WARM_UP

    def wait_until(self, moment: float) -> None:
        """Call ``work`` until shortly before a given moment, and then wait as usual."""
        end = moment - _RESERVE
        while (now := time.perf_counter()) < end:
            self._work()
            left = min(end, now + POLL) - time.perf_counter()
            if left > 0:
                time.sleep(left)
        super().wait_until(moment)

    def wait_for(self, event: threading.Event) -> None:
        """Call ``work`` until an event is set, unless the controller is still capturing graphs."""
        if not self._warm:
            event.wait()
        while not event.wait(POLL):
            self._work()
