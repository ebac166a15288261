"""A controller as the loops of ``lyceum_warp.control.loop`` call it."""

import inspect
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from lyceum_warp.env import Env
from lyceum_warp.validate import described

Controller = Callable[..., torch.Tensor]

_UNKNOWN = (math.nan, math.nan)


class CheckedController:
    """A controller as the loops call it: told the shift if it takes one, and checked."""

    def __init__(self, controller: Controller, env: Env) -> None:
        if not callable(controller):
            raise ValueError(
                f"a controller is called with (state, obs) and returns an action, which {described(controller)} can't"
            )
        if getattr(controller, "env", None) is env:
            raise ValueError(
                "the controller plans in the very environment that it is to control, whose state its roll-outs move "
                "on: control another one, made with lw.make(..., autoreset=False)"
            )
        forward = controller.forward if isinstance(controller, torch.nn.Module) else controller
        if _takes(forward, 1) and not _takes(forward, 2):
            raise ValueError(
                f"a controller is called with (state, obs), and {type(controller).__name__} takes one argument: give "
                "lambda state, obs: policy(obs)"
            )
        self._controller = controller
        self._names = list(env.action_space.parts)
        timestep = getattr(controller, "timestep", env.timestep)
        self._ratio = env.timestep / seconds_of("the timestep of a controller", timestep)
        try:
            self._shifts = "shift" in inspect.signature(controller).parameters
        except (TypeError, ValueError):  # some functions in C have none
            self._shifts = False

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, shift: int, step: int) -> torch.Tensor:
        """A plan, (horizon, nu) float32 on the CPU, the action to take now first; without a plan that alone."""
        action = self._controller(state, obs, **({"shift": shift} if self._shifts else {}))
        plan = getattr(self._controller, "actions", None)
        # a plan holds the action, too: a copy of each from a GPU would be one wait too many
        return self._checked(action, 1, step)[None] if plan is None else self._checked(plan, 2, step)

    def quality(self) -> tuple[float, float]:
        """How many samples of the last plan failed, and its effective number of samples; NaN where unknown."""
        summary = getattr(self._controller, "summary", None)
        if not isinstance(summary, Mapping):
            return _UNKNOWN
        failed, effective = (float(summary.get(name, math.nan)) for name in ("failed_samples", "effective_samples"))
        # of none, a weighted mean has no effective number
        return failed, 0.0 if failed == getattr(self._controller, "samples", None) else effective

    def description(self) -> dict[str, Any]:
        """Name and settings, of what JSON can hold."""
        controller = self._controller
        settings, env = getattr(controller, "settings", None), getattr(controller, "env", None)
        told: dict[str, Any] = {"name": getattr(controller, "__name__", type(controller).__name__)}
        if (samples := getattr(controller, "samples", None)) is not None:
            told["samples"] = samples
        if isinstance(settings, Mapping):
            told |= settings
        if isinstance(env, Env):
            told |= {"engine": env.engine.name, "device": env.device.alias}
        # as a file gives it back; what JSON does not know must not cost an episode
        return dict(json.loads(json.dumps(told, default=str)))

    def reset(self, seed: int | None) -> None:
        """Begin an episode, if the controller wants to be told."""
        if callable(reset := getattr(self._controller, "reset", None)):
            reset(seed)

    def steps(self, plant_steps: int) -> int:
        """The plant's steps in steps of the controller, rounded."""
        return math.floor(plant_steps * self._ratio + 0.5 + 1e-9)

    def index(self, plant_steps: int, horizon: int) -> int:
        """Which action of a plan is for now, so many of the plant's steps after its state."""
        return min(self.steps(plant_steps), horizon - 1)

    def _checked(self, value: Any, ndim: int, step: int) -> torch.Tensor:
        nu, axes = len(self._names), tuple(value.shape) if isinstance(value, torch.Tensor) else ()
        if len(axes) != ndim or axes[-1] != nu or axes[0] == 0:
            wanted = f"return an action of shape ({nu},)" if ndim == 1 else f"have actions of shape (horizon, {nu})"
            raise ValueError(f"a controller has to {wanted}, not {described(value)}")
        plan: torch.Tensor = value.detach().to("cpu", torch.float32, copy=True)  # the next one may be written over it
        if not (finite := torch.isfinite(plan)).all():
            where = (~finite).nonzero()[0].tolist()
            number, name = plan[tuple(where)].item(), self._names[where[-1]]
            raise ValueError(f"the controller wants {name!r} to be {number} at step {step}: it has to be finite")
        return plan


def _takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments."""
    try:
        inspect.signature(function).bind(*[None] * count)
    except (TypeError, ValueError):  # of some functions in C nothing is known
        return False
    return True


def seconds_of(name: str, value: Any) -> float:
    """A positive number of seconds.

    Raises:
        ValueError: It is none.
    """
    if not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ValueError(f"{name} has to be a positive number of seconds, not {value!r}")
    return float(value)
