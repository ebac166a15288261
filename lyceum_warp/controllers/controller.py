"""Define the protocols of controllers, which ``lw.control`` and ``lw.control_async`` call."""

from collections.abc import Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import torch

from lyceum_warp.env.env import Env


class Controller(Protocol):
    """A function that computes an action from the plant's state and observation.

    The plant is an environment of one world. Plain functions and ``lw.MPPI`` are controllers. Control loops also accept
    a policy, a module with the method ``act``. ``PlanningController`` lists optional attributes and methods.
    """

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, /) -> torch.Tensor:
        """Choose an action.

        Args:
            state: State of the plant as in ``env.get_state()[0]``, (state_size,) float64, on the plant's device.
            obs: The plant's observation, (nobs,) float32, on the plant's device.

        Returns:
            The action, (nu,): finite numbers on any device.
        """
        ...


@runtime_checkable
class PlanningController(Controller, Protocol):
    """A controller that plans a sequence of actions, such as ``lw.MPPI``; all attributes and methods are optional.

    There is no need to derive from ``PlanningController``.
    """

    actions: torch.Tensor
    """The last plan, (horizon, nact), all finite. The first action belongs to the given state."""
    timestep: float
    """Simulated seconds between two actions of the plan. By default this is the plant's time step.

    One of the two time steps must be an integer multiple of the other.
    """
    between: Literal["hold", "linear"]
    """How actions are interpolated between two steps of the plan; see ``MPPIConfig.between``."""
    plants: int
    """Number of plants for which the controller plans, by default 1. Control loops require one plant."""
    samples: int
    """Number of samples per plan."""
    summary: Mapping[str, float]
    """Quality of the last plan: ``failed_samples``, and the effective sample size as ``effective_samples``."""
    settings: Mapping[str, Any]
    """Settings to store in ``Trajectory.controller``. Values without a JSON type are converted to strings."""
    env: Env
    """Environment that simulates the plans. Do not use the plant here, because planning changes the state."""

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, /, *, shift: int = 1) -> torch.Tensor:
        """Make a plan.

        Args:
            state: See ``Controller``.
            obs: See ``Controller``.
            shift: Number of controller steps (see ``timestep``) since the initial state of the last plan. The number is
                0 for the first plan after a reset. With ``reset=False``, the loops assume that the previous run made a
                plan whenever one was due. Loops pass ``shift`` only to a controller with an argument of this name.

        Returns:
            The first action of the plan, (nu,). If the controller has an attribute ``actions``, the loops read the
            whole plan from it instead.
        """
        ...

    def reset(self, seed: int | None, /) -> object:
        """Prepare for a new episode. The loops call this method with the run's seed, unless ``reset=False``."""
        ...
