"""Call what controls the worlds: policies of all worlds, and controllers of one world, such as planners."""

import dataclasses
import inspect
import threading
import time
from collections.abc import Mapping
from typing import Any

import torch

from lyceum_warp.algos.networks import moved
from lyceum_warp.algos.policy import Policy, acting
from lyceum_warp.env import Env
from lyceum_warp.support.validate import described

MOST_SAMPLES = 24
"""The most samples of a plan whose paths are drawn."""


class ControllerError(Exception):
    """A controller raised an exception, which is the cause of this one. The message is one line."""

    def __init__(self, name: str, error: BaseException) -> None:
        text = next(iter(str(error).splitlines()), "")
        super().__init__(f"the controller {name!r} failed: {type(error).__name__}{text and ': '}{text}")


@dataclasses.dataclass(frozen=True)
class PlanView:
    """One plan of a planner."""

    state: torch.Tensor
    """The state that it starts from, (state_space.size,) float64."""
    actions: torch.Tensor
    """(horizon, nact)."""
    samples: torch.Tensor
    """The actions of some samples, (horizon, samples, nact); none for planners without samples."""
    best: int | None
    """Index of the sample with the largest return."""


class PolicyControl:
    """A policy that acts in every world, from observations alone.

    Args:
        name: Its name.
        policy: Its ``act``, or else the policy itself, maps (nworld, nobs) observations to (nworld, nact) actions.
        env: The worlds.

    Raises:
        ValueError: It cannot be called with the observations, or returns other actions.
    """

    def __init__(self, name: str, policy: Policy, env: Env) -> None:
        self.name, self.seconds = name, float("nan")
        self._policy, self._env = acting(_on_device(policy, env)), env
        try:
            with torch.no_grad():
                action = self._policy(env.obs)
        except Exception as error:  # a RuntimeError where sizes differ
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
        """Write the actions of all worlds.

        Raises:
            ControllerError: The policy raised an exception, or returned actions of another shape.
        """
        begun = time.perf_counter()
        try:
            self._env.action.copy_(self._policy(self._env.obs))
        except Exception as error:
            raise ControllerError(self.name, error) from error
        self.seconds = time.perf_counter() - begun


class WorldControl:
    """A controller of one world, whose last plan can be looked at.

    Loops call it through ``new_run``. When asked for, it copies the state, the plan and some samples of the next call,
    in the thread of that call.

    Args:
        name: Its name.
        controller: See ``lw.Controller``.
    """

    def __init__(self, name: str, controller: Any) -> None:
        self.name, self.seconds = name, float("nan")
        self.controller = controller
        self._busy = threading.Lock()
        self._run = self.calls = 0
        self._reset_with: tuple[int | None] | None = None
        self._wanted = False
        self._seen: PlanView | None = None
        self.hidden: slice | None = None
        """Columns of the state that the controller sees as zeros: those of a push, which a robot cannot foresee."""

    def new_run(self) -> "ControlRun":
        """The controller for one run of a loop; calls of the runs before fail from now on."""
        self._run += 1
        return ControlRun(self, self._run)

    def end_run(self) -> None:
        """Let further calls of the last run fail. A call that is running ends."""
        self._run += 1

    @property
    def busy(self) -> bool:
        """Whether a call is running."""
        return self._busy.locked()

    def reset(self, seed: int | None = None) -> None:
        """Call the controller's ``reset``, if it has one: at once, or before its next call while a call is running.

        Raises:
            ControllerError: It raised an exception.
        """
        self._reset_with = (seed,)
        if self._busy.acquire(blocking=False):
            try:
                self._reset_now()
            finally:
                self._busy.release()

    def call(self, run: int, state: torch.Tensor, obs: torch.Tensor, **words: Any) -> torch.Tensor:
        """Call the controller.

        Raises:
            ControllerError: It raised an exception, or the run is over.
        """
        with self._busy:  # a call that an interrupted run left behind may not have ended
            if run != self._run:
                raise ControllerError(self.name, RuntimeError("its run is over"))
            self._reset_now()
            if (hidden := self.hidden) is not None:
                state = state.clone()
                state[..., hidden] = 0.0
            begun = time.perf_counter()
            try:
                action = self.controller(state, obs, **words)
            except Exception as error:
                raise ControllerError(self.name, error) from error
            self.calls += 1
            self.seconds = time.perf_counter() - begun
            if self._wanted:
                self._wanted = False
                self._seen = plan_view(self.controller, state)
        return action

    def _reset_now(self) -> None:
        wanted, self._reset_with = self._reset_with, None
        if wanted is not None and callable(reset := getattr(self.controller, "reset", None)):
            try:
                reset(*wanted)
            except Exception as error:
                raise ControllerError(self.name, error) from error

    def look(self) -> PlanView | None:
        """The plan that was copied since the last look, if there is one; asks for another."""
        seen, self._seen = self._seen, None
        self._wanted = True
        return seen


class ControlRun:
    """A controller of one world, for one run of a loop, with every member of the controller.

    Args:
        control: The controller.
        number: The run's number.
    """

    def __init__(self, control: WorldControl, number: int) -> None:
        self._control, self._number = control, number
        self.__name__ = getattr(control.controller, "__name__", type(control.controller).__name__)
        try:
            self.__signature__ = inspect.signature(control.controller)
        except (TypeError, ValueError):  # of some functions written in C
            self.__signature__ = inspect.Signature()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._control.controller, name)

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, **words: Any) -> torch.Tensor:
        """See ``WorldControl.call``."""
        return self._control.call(self._number, state, obs, **words)

    def reset(self, seed: int | None = None) -> None:
        """See ``WorldControl.reset``."""
        self._control.reset(seed)


def plan_view(controller: Any, state: torch.Tensor) -> PlanView | None:
    """Copy the last plan of a controller to the CPU; None for one without plans."""
    plan = getattr(controller, "actions", None)
    if not isinstance(plan, torch.Tensor) or plan.ndim != 2:
        return None
    actions = plan.detach().to("cpu", torch.float32, copy=True)
    samples, best = torch.empty(len(actions), 0, actions.shape[1]), None
    sampled, returns = getattr(controller, "sampled", None), getattr(controller, "returns", None)
    if isinstance(sampled, torch.Tensor) and isinstance(returns, torch.Tensor) and sampled.shape[1] == len(returns):
        count = sampled.shape[1]
        # samples are exchangeable: the first ones are a fair choice; the best one is added
        first = returns.argmax()
        shown = torch.arange(min(MOST_SAMPLES, count), device=returns.device)
        shown[0] = first
        samples = sampled.index_select(1, shown).to("cpu", torch.float32)
        best = 0
    return PlanView(state.detach().to("cpu", torch.float64, copy=True).view(-1), actions, samples, best)


Control = PolicyControl | WorldControl


def controls(given: Mapping[str, Any], env: Env) -> dict[str, Control]:
    """The controllers of a session.

    A function or module of one argument is a policy: it gets the observations of all worlds. One of two arguments, a
    state and an observation, controls one world; see ``lw.Controller``.

    Args:
        given: Controllers by their names.
        env: The worlds.

    Raises:
        ValueError: One of them cannot be called so, or does not fit the task.
    """
    found: dict[str, Control] = {}
    for name, controller in given.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"controllers must have names, as controllers={{'policy': policy}}, not {name!r}")
        if not callable(controller):
            raise ValueError(
                f"the controller {name!r} must be callable, not {described(controller)}: give a policy, as lw.load "
                "returns it, lw.MPPI(...), or a function of (state, obs)"
            )
        if _is_policy(controller):
            found[name] = PolicyControl(name, controller, env)
        else:
            if getattr(controller, "env", None) is env:
                raise ValueError(
                    f"the controller {name!r} plans in the environment that is shown, and planning changes its state: "
                    "show another environment, made with lw.make"
                )
            if (plants := getattr(controller, "plants", 1)) != 1:
                raise ValueError(
                    f"the controller {name!r} plans for {plants} plants, and a controller has one world here: make it "
                    "with plants=1"
                )
            found[name] = WorldControl(name, controller)
    return found


def _is_policy(controller: Any) -> bool:
    """Whether a controller takes observations alone."""
    function: Any = acting(controller)
    if module := isinstance(function, torch.nn.Module):
        function = function.forward
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return False
    try:
        signature.bind(None, None)
    except TypeError:
        return True
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return module and sum(p.default is p.empty and p.kind in places for p in signature.parameters.values()) < 2


def _on_device(policy: Any, env: Env) -> Any:
    """A policy with its parameters on the worlds' device."""
    if isinstance(policy, torch.nn.Module) and any(p.device != env.obs.device for p in policy.parameters()):
        return moved(policy, env)
    return policy
