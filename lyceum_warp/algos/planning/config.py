"""Define and check the settings of MPPI, CEM and predictive sampling."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import torch

from lyceum_warp.algos.planning.updates import PlanUpdate
from lyceum_warp.core.spaces import Space
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, check_word

Numbers: TypeAlias = float | Sequence[float] | Sequence[Sequence[float]] | np.ndarray | torch.Tensor

_RULES: dict[str, Rule] = {
    "horizon": 1, "samples": 1, "models": 1, "iterations": (1, 100_000), "elites": 1, "knots": 1,
    "discount": (0.0, 1.0),
    # the smallest normal float32, because kernels compute in float32
    "temperature": float(np.finfo(np.float32).tiny),
}  # fmt: skip


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class MPPIConfig:
    """Settings of the planners MPPI, CEM and predictive sampling. Arrays and tensors are converted to tuples of floats.

    Raises:
        ValueError: A value is of the wrong type or out of range.
    """

    horizon: int = 32
    """Number of steps in a plan."""
    samples: int = 64
    """Number of samples per improvement of the plan. The planner rolls out each sample in one world per model."""
    update: Literal["mppi", "cem", "predictive_sampling"] | PlanUpdate = "mppi"
    """How to compute the new plan. "mppi" averages all samples with the weights exp(return / temperature). "cem", the
    cross-entropy method, averages the best samples. "predictive_sampling" takes the best sample. A ``PlanUpdate``
    object defines a custom update."""
    temperature: float = 0.1
    """Temperature of MPPI's weights, in units of reward. Low temperatures follow the best sample; high temperatures
    average all samples."""
    elites: int | None = None
    """Number of best samples to which CEM fits the plan and the noise. None means a tenth of the samples, but at least
    two."""
    noise: Numbers = 0.5
    """Noise that is added to the plan, in units of the action. Give a single standard deviation, a standard deviation
    for each action, or a covariance matrix, (nact, nact). CEM adapts the noise, starting from the standard deviations
    in ``noise``."""
    min_noise: float | Sequence[float] | None = None
    """Lower limit of CEM's adapted standard deviations: a single number, or a number for each action. None means a
    tenth of ``noise``."""
    include_plan: bool | None = None
    """Whether the first sample is the plan itself, without noise. None means False with a single sample or with an
    update that adapts the noise, such as CEM. Otherwise, None means True."""
    smoothing: tuple[float, float, float] = (0.25, 0.8, 0.0)
    """Weights (b0, b1, b2) that smooth the noise n over time: e_t = b0 n_t + b1 e_(t-1) + b2 e_(t-2) from the third
    step on. (1, 0, 0) is white noise. The noise of knots is not smoothed."""
    knots: int | None = None
    """Number of spline knots over the horizon. The planner adds noise to the knots, and interpolates actions between
    them. None means a separate action for each step."""
    spline: Literal["zero", "linear", "cubic"] = "cubic"
    """Interpolation of actions between knots: piecewise constant ("zero"), piecewise linear ("linear"), or cubic
    Hermite ("cubic")."""
    between: Literal["hold", "linear"] = "hold"
    """Action to apply between two steps of the plan. "hold" repeats the earlier step's action; "linear" interpolates.
    The setting ``between`` applies if the planner's time step is a multiple of the plant's time step."""
    discount: float | None = None
    """Discount factor of rewards and of the terminal value. None means the value function's discount, or 1 without a
    value function."""
    iterations: int = 1
    """Number of improvements of the plan per call of the planner."""
    fill: str | Numbers = "zero"
    """Action that fills the end of a shifted plan: "zero" (the action nearest to zero), "repeat" (the last action), or
    a given action (a single number, or a number for each element of the action)."""
    termination: Literal["stop", "ignore"] = "stop"
    """How to treat a sample whose episode ends before the horizon. With "stop", rewards after the end do not count.
    With "ignore", all rewards up to the horizon count, as in Lyceum and trajopt."""
    nominal_model: bool = False
    """Whether samples use the nominal values of per-world model fields instead of the values in the given state."""
    models: int = 1
    """Number of models in which each sample is rolled out. With several models, the planner randomizes their model
    fields with the task's ``startup``, ``initialize`` and ``randomize``, and ignores the values in the state."""
    risk: Literal["mean", "worst"] = "mean"
    """How to combine a sample's returns in several models: by their mean ("mean") or by the smallest ("worst")."""

    def __post_init__(self) -> None:
        if not isinstance(self.update, PlanUpdate):
            updates = ("mppi", "cem", "predictive_sampling")
            check_word("update", self.update, updates, ", or an object of a subclass of lw.PlanUpdate")
        check_fields(self, _RULES)
        object.__setattr__(self, "noise", _noise(self.noise))
        object.__setattr__(self, "smoothing", _smoothing(self.smoothing))
        if not isinstance(self.fill, str) or self.fill not in ("zero", "repeat"):
            fill = _numbers("fill", self.fill, "'zero', 'repeat' or an action of finite numbers", low=-math.inf)
            object.__setattr__(self, "fill", fill)
        if self.min_noise is not None:
            deviations = _numbers("min_noise", self.min_noise, "a standard deviation, or one for each action", low=0.0)
            object.__setattr__(self, "min_noise", deviations)
        for name, most in (("elites", "samples"), ("knots", "horizon")):
            if (value := getattr(self, name)) is not None and value > getattr(self, most):
                raise ValueError(f"{name}={value} must be at most {most}, which is {getattr(self, most)}")
        if self.spline != "cubic" and self.knots is None:
            raise ValueError(
                f"spline={self.spline!r} interpolates between knots: give the number of knots, such as knots=4"
            )
        if self.models == 1 and self.risk != "mean":
            raise ValueError(f"risk={self.risk!r} compares models: give the number of models, such as models=4")
        if self.models > 1 and self.nominal_model:
            raise ValueError(
                f"models={self.models} needs random model fields, but nominal_model=True uses nominal values: omit one "
                "of the two settings"
            )

    def changed(self, settings: Mapping[str, Any]) -> "MPPIConfig":
        """Return a copy with changed settings.

        If ``update`` changes, the old update's own settings get their default values.

        Raises:
            ValueError: A value is of the wrong type or out of range.
        """
        changes: dict[str, Any] = {}
        if settings.get("update", self.update) != self.update:
            changes = dict.fromkeys((*_OF_CEM, "include_plan"))
        return dataclasses.replace(self, **{**changes, **settings})

    def completed(self, value: object = None) -> "MPPIConfig":
        """Replace None by defaults, except in ``knots`` and in settings that the update ignores.

        Args:
            value: The planner's value function. If it has a ``discount``, this is the default discount.

        Raises:
            ValueError: A setting does not apply to the update.
        """
        discount = getattr(value, "discount", None)
        adapts = self.update.adapts_noise if isinstance(self.update, PlanUpdate) else self.update == "cem"
        defaults: dict[str, Any] = {
            "discount": 1.0 if discount is None else discount,
            "include_plan": not adapts and self.samples > 1,
        }
        if adapts and np.ndim(self.noise) == 2:
            raise ValueError(
                f"noise of update={self.update!r} must be standard deviations; a covariance was given: {self.noise!r}"
            )
        if self.update == "cem":
            defaults["elites"] = min(self.samples, max(2, self.samples // 10))
            defaults["min_noise"] = _tuples(0.1 * np.asarray(self.noise))
        else:
            for name in _OF_CEM:
                if (value := getattr(self, name)) is not None:
                    raise ValueError(f"{name}={value!r} is a setting of update='cem', not of update={self.update!r}")
        return dataclasses.replace(
            self, **{name: default for name, default in defaults.items() if getattr(self, name) is None}
        )

    def noise_factor(self, nact: int) -> np.ndarray:
        """Compute the lower Cholesky factor of the noise's covariance, (nact, nact).

        Raises:
            ValueError: The size of ``noise`` does not match the actions.
        """
        noise = np.asarray(self.noise)
        if noise.shape in ((), (nact,)):
            return np.diag(np.broadcast_to(noise, nact))
        if noise.shape == (nact, nact):
            return np.linalg.cholesky(noise)
        raise ValueError(
            f"noise must be a standard deviation, {nact} standard deviations, or a positive definite covariance "
            f"({nact}, {nact}), not {self.noise!r}"
        )

    @property
    def noise_smoothing(self) -> tuple[float, float, float]:
        """Return the effective ``smoothing``; knots are not smoothed."""
        return self.smoothing if self.knots is None else (1.0, 0.0, 0.0)

    def fill_action(self, space: Space) -> np.ndarray:
        """Return the clipped action, (nact,), that fills the initial plan and the end of shifted plans.

        Raises:
            ValueError: The size of ``fill`` does not match the actions.
        """
        fill = np.asarray(0.0 if isinstance(self.fill, str) else self.fill)
        if fill.shape not in ((), (space.size,)):
            raise ValueError(f"fill must be 'zero', 'repeat', a number or {space.size} numbers, not {self.fill!r}")
        return np.clip(np.broadcast_to(fill, space.size), space.low, space.high)


_OF_CEM = ("elites", "min_noise")
"""Settings that only CEM uses."""

SETTINGS = tuple(field.name for field in dataclasses.fields(MPPIConfig))
"""Names of the settings."""


def _array(value: Any) -> np.ndarray | None:
    """Convert finite numbers to float64; return None for anything else."""
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value)
        array = array.astype(np.float64) if array.dtype.kind in "iuf" else np.array(math.nan)
    except (TypeError, ValueError):
        return None
    return array if np.isfinite(array).all() else None


def _tuples(array: np.ndarray) -> Any:
    return array.item() if array.ndim == 0 else tuple(map(_tuples, array))


def _numbers(name: str, value: Any, rule: str, *, low: float) -> Any:
    array = _array(value)
    if array is None or array.ndim > 1 or not array.size or (array < low).any():
        raise ValueError(f"{name} must be {rule}, not {value!r}")
    return _tuples(array)


def _noise(noise: Any) -> Any:
    array = _array(noise)
    if array is not None and array.size:
        if array.ndim < 2 and (array >= 0).all():
            return _tuples(array)
        if array.ndim == 2 and array.shape[0] == array.shape[1] and np.allclose(array, array.T):
            try:
                np.linalg.cholesky(array)
                return _tuples(array)
            except np.linalg.LinAlgError:
                pass
    raise ValueError(
        "noise must be a standard deviation, a standard deviation for each action, or a positive definite "
        f"covariance, not {noise!r}"
    )


def _smoothing(smoothing: Any) -> Any:
    array = _array(smoothing)
    if array is None or array.shape != (3,):
        raise ValueError(f"smoothing must be 3 finite numbers, not {smoothing!r}")
    b0, b1, b2 = array.tolist()
    # check the stability triangle of a second-order filter; its poles are the roots of z^2 - b1 z - b2
    if not (abs(b2) < 1 and abs(b1) < 1 - b2):
        raise ValueError(
            f"smoothing {(b0, b1, b2)} is unstable: e_t = b0 n_t + b1 e_(t-1) + b2 e_(t-2) must have its poles inside "
            "the unit circle, so choose |b2| < 1 and |b1| < 1 - b2"
        )
    return b0, b1, b2
