"""Define the protocols of controllers, which ``lw.control`` and ``lw.control_async`` call."""

from collections.abc import Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import torch

from lyceum_warp.env import Env


class Controller(Protocol):
    """A function that returns an action for the state and the observation of one world, the plant.

    Plain functions and ``lw.MPPI`` are controllers. To control with a policy, pass ``lambda state, obs: policy(obs)``.
    Further attributes and methods are optional; ``PlanningController`` lists them.
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
    """A controller that plans a sequence of actions and returns the first action, such as ``lw.MPPI``.

    A controller implements only those attributes and methods that it needs. It need not derive from
    ``PlanningController``.
    """

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, /, *, shift: int = 1) -> torch.Tensor:
        """Make a plan.

        Args:
            state: See ``Controller``.
            obs: See ``Controller``.
            shift: Number of steps of length ``timestep`` since the initial state of the last plan; 0 for the first plan
                after a reset. With ``reset=False``, the loops assume that the last plan was made in the previous step
                or, with ``replan_every``, in the last step for which a plan was due. The loops pass ``shift`` only if
                the controller has an argument of this name.

        Returns:
            The first action of the plan, (nu,). If the controller has an attribute ``actions``, the loops instead read
            the whole plan from this attribute.
        """
        ...

    def reset(self, seed: int | None, /) -> object:
        """Prepare for a new episode. The loops call this method with the run's seed, unless ``reset=False``."""
        ...

    @property
    def actions(self) -> torch.Tensor:
        """The last plan, (horizon, nact): finite numbers. The first action is for the given state."""
        ...

    @property
    def timestep(self) -> float:
        """Simulated seconds between two actions of the plan; by default the plant's time step.

        The controller's time step must be a whole multiple or a whole fraction of the plant's time step.
        """
        ...

    @property
    def between(self) -> Literal["hold", "linear"]:
        """Which action the plant applies between two actions of the plan; see ``MPPIConfig.between``."""
        ...

    @property
    def plants(self) -> int:
        """Number of plants for which the controller plans, by default 1. Control loops require one plant."""
        ...

    @property
    def samples(self) -> int:
        """Number of samples per plan."""
        ...

    @property
    def summary(self) -> Mapping[str, float]:
        """Quality of the last plan: ``failed_samples`` and ``effective_samples`` (the effective sample size)."""
        ...

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings to store in ``Trajectory.controller``. Values without a JSON type are converted to strings."""
        ...

    @property
    def env(self) -> Env:
        """Environment that simulates the plans. It must not be the plant itself, because planning changes the state."""
        ...
