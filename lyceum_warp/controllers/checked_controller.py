"""Check the actions of controllers, and select a plan's action for each step of the plant."""

import inspect
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from lyceum_warp.controllers.controller import Controller
from lyceum_warp.env import Env, Player
from lyceum_warp.support.validate import described, positive_number


class CheckedController:
    """Calls a controller, checks its actions, and selects a plan's action for each step of the plant."""

    def __init__(self, controller: Controller, env: Env) -> None:
        if hasattr(controller, "act"):
            controller = _PolicyController(controller, env)
        _check_call(controller)
        if getattr(controller, "env", None) is env:
            raise ValueError(
                "the controller plans in the environment that it controls, and planning changes its state: control "
                "another environment, made with lw.make(..., autoreset=False)"
            )
        if (plants := getattr(controller, "plants", 1)) != 1:
            raise ValueError(
                f"the controller plans for {plants} plants, but this loop controls one: make the controller with "
                "plants=1, or control the worlds of an environment with env.step(plan(env.get_state()))"
            )
        self._controller: Any = controller
        self._names = env.action_space.columns
        timestep = getattr(controller, "timestep", env.timestep)
        self._plan_steps, self._plant_steps = _steps(
            env.timestep, positive_number("the timestep of a controller", timestep, "seconds")
        )
        self._linear = getattr(controller, "between", "hold") == "linear"
        self._takes_shift = (signature := signature_of(controller)) is not None and "shift" in signature.parameters

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, shift: int, step: int) -> torch.Tensor:
        """Return the plan for a state, (horizon, nact) float32, on the CPU."""
        action = self._controller(state, obs, **({"shift": shift} if self._takes_shift else {}))
        plan = getattr(self._controller, "actions", None)
        # do not copy the returned action, because a second copy would wait for the device again
        return self._checked(action, 1, step)[None] if plan is None else self._checked(plan, 2, step)

    def reset(self, seed: int | None) -> None:
        """Call the controller's ``reset``, if it has one."""
        if callable(reset := getattr(self._controller, "reset", None)):
            reset(seed)

    def quality(self) -> tuple[float, float]:
        """Get the last plan's number of failed samples and effective sample size, or NaN if unknown."""
        summary = getattr(self._controller, "summary", None)
        if not isinstance(summary, Mapping):
            return math.nan, math.nan
        failed = float(summary.get("failed_samples", math.nan))
        effective = float(summary.get("effective_samples", math.nan))
        # weights are undefined if all samples failed
        return failed, 0.0 if failed == getattr(self._controller, "samples", None) else effective

    def steps(self, plant_steps: int) -> int:
        """Return how many controller steps are complete after a number of plant steps."""
        return plant_steps * self._plan_steps // self._plant_steps

    def passed(self, before: int, now: int) -> int:
        """Count the controller steps that end between two plant steps."""
        return self.steps(now) - self.steps(before)

    def action(self, plan: torch.Tensor, plant_steps: int) -> torch.Tensor:
        """Select the action for the time ``plant_steps`` after the plan's initial state.

        An action is held until the controller's next step, or interpolated towards the next action if the controller
        has ``between="linear"``.
        """
        index, remainder = divmod(plant_steps * self._plan_steps, self._plant_steps)
        if remainder and self._linear and index < len(plan) - 1:
            return torch.lerp(plan[index], plan[index + 1], remainder / self._plant_steps)
        return plan[min(index, len(plan) - 1)]

    def check_horizon(self, horizon: int, steps: int) -> None:
        """Check that a plan of ``horizon`` actions is long enough for the given number of plant steps."""
        if (needed := self.steps(steps - 1) + 1) > horizon:
            plan = (
                f"a plan of {horizon} actions" if hasattr(self._controller, "actions") else "no plan, only one action"
            )
            raise ValueError(
                f"replan_every={steps} needs a plan of {needed} actions, but the controller has {plan}: plan more "
                "often, or give the planner a longer horizon"
            )

    def description(self) -> dict[str, Any]:
        """Describe the controller's name, settings, engine and device; see ``Trajectory.controller``."""
        controller = self._controller
        description: dict[str, Any] = {"name": getattr(controller, "__name__", type(controller).__name__)}
        if (samples := getattr(controller, "samples", None)) is not None:
            description["samples"] = samples
        if isinstance(settings := getattr(controller, "settings", None), Mapping):
            description |= settings
        if isinstance(env := getattr(controller, "env", None), Env):
            description |= {"engine": env.engine.name, "device": env.device.alias}
        # make the types equal to those in a loaded file
        return dict(json.loads(json.dumps(description, default=str)))

    def _checked(self, value: Any, ndim: int, step: int) -> torch.Tensor:
        nu, axes = len(self._names), tuple(value.shape) if isinstance(value, torch.Tensor) else ()
        if len(axes) != ndim or axes[-1] != nu or axes[0] == 0:
            rule = f"return an action of shape ({nu},)" if ndim == 1 else f"have actions of shape (horizon, {nu})"
            raise ValueError(f"a controller must {rule}, not {described(value)}")
        plan: torch.Tensor = value.detach().to("cpu", torch.float32, copy=True)  # the next call may overwrite the plan
        if not (finite := torch.isfinite(plan)).all():
            where = (~finite).nonzero()[0].tolist()
            number, name = plan[tuple(where)].item(), self._names[where[-1]]
            raise ValueError(f"the controller's action {name!r} at step {step} must be finite, not {number}")
        return plan


class _PolicyController:
    """Calls a policy, which acts in all worlds, as a controller of one world."""

    def __init__(self, policy: Any, env: Env) -> None:
        self.__name__, self._player = type(policy).__name__, Player(policy, env)

    def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return self._player(obs[None])[0]


def _steps(plant: float, plan: float) -> tuple[int, int]:
    """Return the smallest numbers of plan steps and plant steps that last equally long."""
    many = round(max(plant, plan) / min(plant, plan))
    if not math.isclose(many * min(plant, plan), max(plant, plan), rel_tol=1e-6):
        raise ValueError(
            f"the controller's step is {plan:g} s and the plant's step is {plant:g} s, but one must be a multiple of "
            "the other: change the planner's frame_skip or timestep"
        )
    return (many, 1) if plant > plan else (1, many)


def _check_call(controller: Any) -> None:
    if not callable(controller):
        raise ValueError(
            f"a controller must be callable with (state, obs), not {described(controller)}: pass a function, or "
            "lw.MPPI(...)"
        )
    signature = signature_of(controller)
    if signature is not None and accepts(signature, 1) and not accepts(signature, 2):
        raise ValueError(
            f"control loops call a controller with (state, obs), but {type(controller).__name__} takes one argument: "
            "pass lambda state, obs: policy(obs)"
        )


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature of a function or of a module's ``forward``, or None if it is unknown."""
    try:
        return inspect.signature(function.forward if isinstance(function, torch.nn.Module) else function)
    except (TypeError, ValueError):  # some C functions have no signature
        return None


def accepts(signature: inspect.Signature, count: int) -> bool:
    """Return whether a function can be called with ``count`` positional arguments."""
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True
