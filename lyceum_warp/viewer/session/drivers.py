"""Call policies, which act in all worlds, and controllers of one world, such as planners."""

import dataclasses
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import torch

from lyceum_warp.algos import Planner
from lyceum_warp.controllers import CheckedController, accepts, signature_of
from lyceum_warp.env import Env, Player, Policy

MOST_SAMPLES = 24
"""Maximum number of samples whose paths the viewer shows."""

_WARM_UP = 3  # the first calls may capture CUDA graphs, so nothing else runs meanwhile


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
        self._player, self._env = Player(policy, env), env
        with torch.no_grad():
            self._player.first(env.obs)

    def act(self) -> None:
        """Write the actions of all worlds."""
        start = time.perf_counter()
        try:
            self._env.action.copy_(self._player(self._env.obs))
        except Exception as error:
            raise ControllerError(self.name, error) from error
        self.seconds = time.perf_counter() - start


class WorldControl:
    """Calls a controller of one world in a thread, as ``lw.control_async`` does.

    The controller plans from the newest measured state, at most once per state. Steps are counted from the beginning of
    the session.
    """

    def __init__(self, name: str, controller: Any, env: Env) -> None:
        self.name, self.seconds = name, float("nan")
        self.controller = controller
        self.plans = hasattr(controller, "actions")
        self._checked = CheckedController(controller, env)
        self._thread = ThreadPoolExecutor(1, "lyceum_warp planner")
        self._call: Future[Plan] | None = None
        self._plan: Plan | None = None
        self._state: tuple[int, torch.Tensor, torch.Tensor] | None = None
        self._calls = self._planned = self._resets = 0
        self._reset_due = self._copy_due = False
        self._view: PlanView | None = None

    @property
    def busy(self) -> bool:
        """Whether a call of the controller is running."""
        return self._call is not None and not self._call.done()

    def reset(self) -> None:
        """Drop the plan, and reset the controller before its next call."""
        self._reset_due, self._plan, self._state = True, None, None
        self._resets += 1

    def action(self, step: int, state: torch.Tensor, obs: torch.Tensor, *, wait: bool) -> torch.Tensor | None:
        """Measure the state before a step, and return the action that the newest plan has for this step.

        Args:
            step: The number of earlier steps.
            state: The state, (state_space.size,).
            obs: The observation, (nobs,).
            wait: Whether to wait for a plan from this state.

        Returns:
            The action, (nact,), or None before the first plan.

        Raises:
            ControllerError: The controller raised an exception, or its actions are invalid.
        """
        self._state = step, state, obs
        self._follow(wait=wait)
        return None if self._plan is None else self._checked.action(self._plan.actions, step - self._plan.step)

    def rest(self, seconds: float) -> None:
        """Wait. When a call ends, begin the next one."""
        if self._call is None:
            time.sleep(seconds)
        else:
            wait([self._call], seconds)
            self._follow(wait=False)

    def look(self) -> PlanView | None:
        """Return the plan that was copied since the last call, and request a copy of the next plan."""
        view, self._view = self._view, None
        self._copy_due = True
        return view

    def close(self) -> None:
        """End the thread after a call in progress."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _follow(self, *, wait: bool) -> None:
        wait = wait or self._calls < _WARM_UP
        if self.busy and not wait:
            return
        self._take()
        if self._state is not None and (wait or self._plan is None or self._plan.step < self._state[0]):
            self._call = self._thread.submit(self._work, *self._state, self._resets)
            if wait:
                self._take()

    def _take(self) -> None:
        """Wait for a call in progress, and take its plan, unless the controller was reset meanwhile."""
        if self._call is not None:
            call, self._call = self._call, None
            plan = call.result()
            if plan.resets == self._resets:
                self._plan = plan

    @torch.no_grad()
    def _work(self, step: int, state: torch.Tensor, obs: torch.Tensor, resets: int) -> "Plan":
        reset, self._reset_due = self._reset_due, False
        try:
            if reset:
                self._checked.reset(None)
                self._planned = step
            start = time.perf_counter()
            actions = self._checked(state, obs, self._checked.passed(self._planned, step), step)
        except Exception as error:
            raise ControllerError(self.name, error) from error
        self._planned = step
        self._calls += 1
        self.seconds = time.perf_counter() - start
        if self._copy_due:
            self._copy_due = False
            self._view = plan_view(self.controller, state)
        return Plan(actions, step, resets)


class Plan(NamedTuple):
    """A plan with the number of steps, and of resets of its controller, before its initial state."""

    actions: torch.Tensor
    step: int
    resets: int


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


def controls_by_name(controllers: Mapping[str, Any], env: Env) -> dict[str, Control]:
    """Check controllers. A policy takes one argument, and a controller of one world takes two.

    Raises:
        ValueError: A controller is not callable, or does not fit the task.
    """
    controls: dict[str, Control] = {}
    for name, controller in controllers.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"controllers must have names, as controllers={{'policy': policy}}, not {name!r}")
        kind = PolicyControl if _is_policy(controller) else WorldControl
        try:
            controls[name] = kind(name, controller, env)
        except Exception as error:
            text = f"the controller {name!r} does not fit the task {env.task.name!r}: {type(error).__name__}: {error}"
            raise ValueError(text) from error
    return controls


def _is_policy(controller: Any) -> bool:
    if hasattr(controller, "act"):
        return True
    if (signature := signature_of(controller)) is None:
        return False
    return not accepts(signature, 2) or (isinstance(controller, torch.nn.Module) and accepts(signature, 1))
