"""Choose the largest setting of a planner that meets a real-time deadline, by measuring planning times."""

import bisect
import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from lyceum_warp.controllers.controller import Controller
from lyceum_warp.controllers.real_time import control_async
from lyceum_warp.env.env import Env

SHARE = 0.8
"""A setting meets a deadline if 99 % of its plans take at most this fraction of the deadline."""

_SECONDS = 0.4  # a measurement lasts this long, but at least _STEPS steps
_STEPS = 12


@dataclasses.dataclass(frozen=True)
class RealTimeSetting:
    """The settings that determine a planner's planning time."""

    samples: int
    horizon: int
    physics: str | None = None
    """Name of the planner's physics options; None if they have no name."""

    def __str__(self) -> str:
        physics = "" if self.physics is None else f", physics {self.physics}"
        return f"{self.samples} samples, horizon {self.horizon}{physics}"


@dataclasses.dataclass(frozen=True)
class RealTimeChoice:
    """The chosen setting of a planner, with its planning time.

    Planning times are 99 % quantiles in seconds.
    """

    setting: RealTimeSetting
    """The largest setting that meets the deadline, or else the fastest one."""
    planning_time: float
    deadline: float
    larger: tuple[int, float] | None
    """The next larger number of samples, and its planning time, which misses the deadline. None if there is no larger
    number, or if no setting meets the deadline."""

    @property
    def replan_every(self) -> int:
        """Number of plant steps per plan, if a step lasts as long as the deadline."""
        return max(1, math.ceil(self.planning_time / (SHARE * self.deadline)))

    def __str__(self) -> str:
        text = f"{self.setting}: {_ms(self.planning_time)} of {_ms(self.deadline)}"
        if self.replan_every > 1:
            every = _ms(self.replan_every * self.deadline)
            return f"no setting meets the deadline; {text}, so there is a plan every {every}"
        return text if self.larger is None else f"{text}; {self.larger[0]} would take {_ms(self.larger[1])}"


def choose_setting(
    samples: Sequence[int],
    horizons: Sequence[int],
    physics: Sequence[str | None],
    measure: Callable[[RealTimeSetting], float],
    *,
    deadline: float,
) -> RealTimeChoice:
    """Choose the largest number of samples for which planning meets a deadline.

    If even the smallest number of samples is too slow, try shorter horizons, and then other physics options.
    """
    budget, misses = SHARE * deadline, []
    for name in physics:
        for horizon in horizons:
            times: dict[int, float] = {}
            low, high, index = -1, len(samples), 0  # samples[low] meets the deadline, samples[high] does not
            while high - low > 1:
                setting = RealTimeSetting(samples[index], horizon, name)
                seconds = times[samples[index]] = measure(setting)
                if seconds > budget:
                    high = index
                    misses.append(RealTimeChoice(setting, seconds, deadline, None))
                else:
                    low = index
                # the planning time grows at most in proportion to the number of samples
                reachable = bisect.bisect(samples, samples[index] * budget / seconds) - 1
                index = min(max(reachable, low + 1), high - 1)
            if low >= 0:
                larger = None if high == len(samples) else (samples[high], times[samples[high]])
                setting = RealTimeSetting(samples[low], horizon, name)
                return RealTimeChoice(setting, times[setting.samples], deadline, larger)
    return min(misses, key=lambda choice: choice.planning_time)


def planning_time(plant: Env, planner: Controller) -> float:
    """Measure a planner in real time for about half a second, and restore the plant's state.

    Returns:
        The 99 % quantile of the planning times, in seconds.
    """
    before = plant.get_state()
    done = control_async(plant, planner, steps=max(_STEPS, round(_SECONDS / plant.timestep)), seed=0)
    plant.set_state(before)
    return float(np.quantile(done.plan_times.numpy(), 0.99))


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
