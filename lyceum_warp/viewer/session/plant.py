"""Make the plant, a copy of the displayed world, and the clock of its control loop."""

import threading
import time
from collections.abc import Callable

from lyceum_warp.controllers import Clock
from lyceum_warp.engines import options_for_plant
from lyceum_warp.viewer.session.drivers import WorldControl
from lyceum_warp.viewer.session.live import PLANT_HISTORY_BYTES, Live

POLL = 0.005
"""Seconds between two polls of the window's commands."""

_RESERVE = 0.0015  # no other work starts within this many seconds before a step
_WARM_UP = 3  # no other work runs during the controller's first calls, which may capture CUDA graphs


class InterruptedByCommand(BaseException):
    """Raised to end the plant's control loop, so that a command can be carried out."""


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
    """Waits as ``Clock`` does, and calls ``work`` meanwhile."""

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
        """Wait for an event. Meanwhile, call ``work``, except while the controller may capture CUDA graphs."""
        if not self._warm:
            event.wait()
        while not event.wait(POLL):
            self._work()
