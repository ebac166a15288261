"""Call policies, which act in all worlds, and controllers of one world, such as planners."""

import dataclasses
import threading
import time
from collections.abc import Mapping
from typing import Any

import torch

from lyceum_warp.algos import Planner, Policy, acting, moved
from lyceum_warp.controllers import CheckedController, accepts, signature_of
from lyceum_warp.env import Env
from lyceum_warp.support.validate import described, memoryless_action

MOST_SAMPLES = 24
"""Maximum number of samples whose paths the viewer shows."""


class ControllerError(Exception):
    """A controller raised an exception, which is the ``__cause__``. The message is a single line."""

    def __init__(self, name: str, error: BaseException) -> None:
        text = next(iter(str(error).splitlines()), "")
        super().__init__(f"the controller {name!r} failed: {type(error).__name__}{text and ': '}{text}")


@dataclasses.dataclass(frozen=True)
class PlanView:
    """A copy of a plan and of some of its samples on the CPU."""

    state: torch.Tensor
    """The initial state of the plan, (state_space.size,) float64."""
    actions: torch.Tensor
    """The actions of the plan, (horizon, nact)."""
    samples: torch.Tensor
    """The actions of the samples, (horizon, samples, nact). The first sample has the largest return."""


class PolicyControl:
    """Calls a policy that acts in all worlds."""

    def __init__(self, name: str, policy: Policy, env: Env) -> None:
        self.name, self.seconds = name, float("nan")
        self._policy, self._env = acting(_on_device(policy, env)), env
        try:
            with torch.no_grad():
                action = memoryless_action(self._policy, env.obs)
        except Exception as error:
            raise ValueError(
                f"{ControllerError(name, error)}: it was called with the observations of {env.task.name!r}, "
                f"{described(env.obs)}"
            ) from error
        if not isinstance(action, torch.Tensor) or action.shape != env.action.shape:
            raise ValueError(
                f"the controller {name!r} must return actions of shape {tuple(env.action.shape)} for "
                f"{env.task.name!r}, not {described(action)}"
            )

    def act(self) -> None:
        """Write the actions of all worlds."""
        start = time.perf_counter()
        try:
            self._env.action.copy_(self._policy(self._env.obs))
        except Exception as error:
            raise ControllerError(self.name, error) from error
        self.seconds = time.perf_counter() - start


class WorldControl:
    """Calls a controller of one world."""

    def __init__(self, name: str, controller: Any) -> None:
        self.name, self.seconds = name, float("nan")
        self.controller = controller
        self.plans = hasattr(controller, "actions")
        self._busy = threading.Lock()
        self._run = self.calls = 0
        self._reset_due = self._copy_due = False
        self._plan: PlanView | None = None
        self.hidden: slice | None = None
        """The columns of the state that hold the user's push force. Controllers see zeros in these columns."""

    def new_run(self) -> "ControlRun":
        """Return the controller for a new control loop. Calls from earlier control loops then fail."""
        self._run += 1
        return ControlRun(self, self._run)

    @property
    def busy(self) -> bool:
        """Whether a call of the controller is running."""
        return self._busy.locked()

    def reset(self) -> None:
        """Reset the controller before its next call."""
        self._reset_due = True

    def call(self, run: int, state: torch.Tensor, obs: torch.Tensor, **options: Any) -> torch.Tensor:
        """Call the controller.

        Raises:
            ControllerError: The controller raised an exception, or a newer control loop has begun.
        """
        with self._busy:  # a call from an interrupted control loop may still be running
            if run != self._run:
                raise ControllerError(self.name, RuntimeError("its control loop has ended"))
            if (hidden := self.hidden) is not None:
                state = state.clone()
                state[..., hidden] = 0.0
            due, self._reset_due = self._reset_due, False
            try:
                if due and callable(reset := getattr(self.controller, "reset", None)):
                    reset(None)
                start = time.perf_counter()
                action = self.controller(state, obs, **options)
            except Exception as error:
                raise ControllerError(self.name, error) from error
            self.calls += 1
            self.seconds = time.perf_counter() - start
            if self._copy_due:
                self._copy_due = False
                self._plan = plan_view(self.controller, state)
        return action

    def look(self) -> PlanView | None:
        """Return the plan that was copied since the last call, and request a copy of the next plan."""
        plan, self._plan = self._plan, None
        self._copy_due = True
        return plan


class ControlRun:
    """Wraps a controller for one control loop, with the same attributes and signature."""

    def __init__(self, control: WorldControl, number: int) -> None:
        self._control, self._number = control, number
        self.__name__ = getattr(control.controller, "__name__", type(control.controller).__name__)
        self.__wrapped__ = control.controller  # inspect.signature returns the signature of __wrapped__

    def __getattr__(self, name: str) -> Any:
        return getattr(self._control.controller, name)

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, **options: Any) -> torch.Tensor:
        """See ``WorldControl.call``."""
        return self._control.call(self._number, state, obs, **options)


def plan_view(controller: Any, state: torch.Tensor) -> PlanView | None:
    """Copy the last plan of a controller to the CPU, or return None for a controller without plans."""
    plan = getattr(controller, "actions", None)
    if not isinstance(plan, torch.Tensor) or plan.ndim != 2:
        return None
    actions = plan.detach().to("cpu", torch.float32, copy=True)
    samples = torch.empty(len(actions), 0, actions.shape[1])
    if isinstance(controller, Planner):
        # samples are drawn independently, so the first ones represent all of them
        indices = torch.arange(min(MOST_SAMPLES, controller.samples), device=plan.device)
        indices[0] = controller.returns.argmax()
        samples = controller.sampled.index_select(1, indices).to("cpu", torch.float32)
    return PlanView(state.detach().to("cpu", torch.float64, copy=True).view(-1), actions, samples)


Control = PolicyControl | WorldControl


def controls(controllers: Mapping[str, Any], env: Env) -> dict[str, Control]:
    """Check controllers. A policy takes one argument, and a controller of one world takes two.

    Raises:
        ValueError: A controller is not callable, or does not fit the task.
    """
    controls: dict[str, Control] = {}
    for name, controller in controllers.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"controllers must have names, as controllers={{'policy': policy}}, not {name!r}")
        if _is_policy(controller):
            controls[name] = PolicyControl(name, controller, env)
            continue
        try:
            CheckedController(controller, env)
        except ValueError as error:
            raise ValueError(f"the controller {name!r} does not fit: {error}") from error
        controls[name] = WorldControl(name, controller)
    return controls


def _is_policy(controller: Any) -> bool:
    function = acting(controller)
    if (signature := signature_of(function)) is None:
        return False
    return not accepts(signature, 2) or (isinstance(function, torch.nn.Module) and accepts(signature, 1))


def _on_device(policy: Any, env: Env) -> Any:
    if isinstance(policy, torch.nn.Module) and any(p.device != env.obs.device for p in policy.parameters()):
        return moved(policy, env)
    return policy
