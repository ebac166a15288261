"""Define plan updates, which turn samples into the next plan: MPPI, CEM and predictive sampling.

The planner (``planner.py``) rolls out the samples and computes their weighted mean.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp

from lyceum_warp.kernels import planning


@dataclasses.dataclass(frozen=True)
class PlanSamples:
    """The samples of one planning iteration.

    Plans and samples have one row for each step of the horizon, or for each knot if the planner uses knots. All tensors
    are float32 on the device of the planner's worlds. A plan update must write into the tensors and must not replace
    them.
    """

    returns: torch.Tensor
    """The samples' returns, (plants, samples); minus infinity for failed samples."""
    weights: torch.Tensor
    """The samples' weights, (plants, samples), written by ``weigh``. They must not be negative, must be 0 for failed
    samples, and must sum to 1 for each plant. If all samples of a plant failed, the planner ignores the weights, and
    its plan and its noise do not change."""
    actions: torch.Tensor
    """The samples' actions, (rows, plants, samples, nact)."""
    nominal: torch.Tensor
    """The plans around which the samples were drawn, (rows, plants, nact)."""
    plan: torch.Tensor
    """The new plans, (rows, plants, nact): the weighted means of the samples. ``fit`` may change them."""
    nominal_deviation: torch.Tensor | None
    """Standard deviations of the samples' noise before smoothing, (rows, plants, nact); None if ``adapts_noise`` is
    False."""
    deviation: torch.Tensor | None
    """Standard deviations of the noise for the next planning iteration, written by ``fit``."""
    summary: torch.Tensor
    """Best return, mean return, effective sample size and number of failed samples, (plants, 4). If ``capturable`` is
    set, ``weigh`` must write this tensor."""


class PlanUpdate(abc.ABC):
    """Base class of updates that turn samples into the next plan, as in ``lw.Planner(task, update=MyUpdate(...))``.

    A subclass implements ``weigh``; the new plan is the weighted mean of the samples. A subclass may also implement
    ``fit``, for example to adapt the noise. Each planner uses a shallow copy of the given object, so ``prepare`` may
    store buffers as attributes.
    """

    capturable: ClassVar[bool] = False
    """Whether a CUDA graph can capture ``weigh`` and ``fit``. Both must then consist of Warp launches on arrays at
    fixed addresses. Otherwise they may use torch, and the planner calls them between two graphs."""
    adapts_noise: ClassVar[bool] = False
    """Whether ``fit`` adapts a separate standard deviation of the noise for each element of a plan. Otherwise, the
    planner's setting ``noise`` gives the standard deviations."""

    def prepare(self, samples: PlanSamples) -> None:
        """Check sizes and allocate buffers; called once, when the planner is made."""
        return

    @abc.abstractmethod
    def weigh(self, samples: PlanSamples) -> None:
        """Write ``samples.weights`` from ``samples.returns``."""

    def fit(self, samples: PlanSamples) -> None:
        """Adapt ``samples.deviation``, or change ``samples.plan`` within the actions' bounds; do nothing by default."""
        return

    def __repr__(self) -> str:
        """Format the public attributes, for the planner's ``settings``."""
        attributes = (f"{name}={value!r}" for name, value in vars(self).items() if not name.startswith("_"))
        return f"{type(self).__name__}({', '.join(attributes)})"


def by_sample(tensor: torch.Tensor) -> Any:
    """Convert a tensor of ``PlanSamples`` to a Warp array, with the axes of plants and samples merged."""
    plants = 0 if tensor.ndim == 2 else 1
    return wp.from_torch(tensor.flatten(plants, plants + 1))


def launch_blocks(kernel: wp.Kernel, blocks: int, args: Sequence[Any]) -> None:
    """Launch a kernel with blocks of 256 threads, on the device of its first argument."""
    wp.launch_tiled(kernel, dim=[blocks], inputs=args, block_dim=256, device=args[0].device)


class SampleWeights(PlanUpdate):
    """Update plans by MPPI, or take the mean of the best samples.

    With MPPI, the weight of sample k of the planner (``planner.py``) with the return R_k is

        w_k = exp((R_k - max R) / temperature) / sum_j exp((R_j - max R) / temperature),

    as in Williams et al., 2017 ("Information theoretic MPC for model-based reinforcement learning"), without a cost on
    the controls. With ``elites``, this number of best samples have equal weights instead. A failed sample has the
    weight 0.

    With a single elite, this is predictive sampling: the sample with the largest return becomes the new plan. The
    previous plan is one of the samples, so only a better plan can replace it. Predictive sampling was proposed by
    Howell et al., 2022 ("Predictive sampling: real-time behaviour synthesis with MuJoCo"), for plans that are splines
    with a few knots.

    Args:
        temperature: Temperature of the weights, in units of reward.
        elites: Number of best samples; 0 for MPPI's weights.
    """

    capturable = True

    def __init__(self, *, temperature: float = 1.0, elites: int = 0) -> None:
        self.temperature, self.elites = temperature, elites

    def prepare(self, samples: PlanSamples) -> None:
        """Allocate the samples' ranks."""
        self._rank = torch.zeros_like(samples.returns, dtype=torch.int32)

    def weigh(self, samples: PlanSamples) -> None:
        """Weigh the samples that did not fail."""
        returns, rank = by_sample(samples.returns), by_sample(self._rank)
        plants, count = samples.returns.shape
        if self.elites:
            wp.launch(planning.rank, plants * count, [returns, count, rank], device=returns.device)
        args = [returns, rank, self.elites, self.temperature, by_sample(samples.weights)]
        launch_blocks(planning.weigh, plants, [*args, wp.from_torch(samples.summary)])


class CrossEntropy(SampleWeights):
    """Update plans by the cross-entropy method (CEM): fit a normal distribution to the best samples.

    CEM was proposed by Rubinstein (1999, "The cross-entropy method for combinatorial and continuous optimization"). The
    noise has a standard deviation s_t for each element of the plan. The n best samples u_t^1, ..., u_t^n are called
    elites. They determine the next plan and the next noise:

        u_t = 1/n sum_k u_t^k,    s_t = max(sqrt(1/n sum_k (u_t^k - u_t)^2), min_noise)

    The covariance is diagonal, as in hydrax, judo and MuJoCo MPC. Smoothing multiplies the noise's standard deviation
    by ``spread``. The elites' standard deviation is therefore divided by ``spread``.

    Args:
        elites: Number of best samples.
        min_noise: Lower limit of the standard deviations: one number, or one number for each action.
        smoothing: Weights (b0, b1, b2) that smooth the noise over time.
    """

    adapts_noise = True

    def __init__(self, elites: int, min_noise: float | Sequence[float], smoothing: tuple[float, float, float]) -> None:
        super().__init__(elites=elites)
        self.min_noise, self.smoothing = min_noise, smoothing

    def prepare(self, samples: PlanSamples) -> None:
        """Allocate buffers."""
        super().prepare(samples)
        count, _, nact = samples.plan.shape
        smallest = np.asarray(self.min_noise)
        if smallest.shape not in ((), (nact,)):
            raise ValueError(
                f"min_noise must be one standard deviation, or one for each of the {nact} actions, not "
                f"{self.min_noise!r}"
            )
        self._smallest = torch.as_tensor(np.full(nact, smallest)).to(samples.plan)
        self._spread = torch.as_tensor(spread(self.smoothing, count)).to(samples.plan)

    def fit(self, samples: PlanSamples) -> None:
        """Fit the noise to the elites."""
        plan, before, after = samples.plan, samples.nominal_deviation, samples.deviation
        assert before is not None and after is not None
        args = [wp.from_torch(t) for t in (plan, self._spread, self._smallest, before, samples.summary, after)]
        rows = [by_sample(samples.weights), by_sample(samples.actions)]
        launch_blocks(planning.fit_deviation, plan.numel(), [*rows, *args])


def spread(smoothing: tuple[float, float, float], count: int) -> np.ndarray:
    """Compute the standard deviation of smoothed noise in each step, (count,).

    Standard normal noise n_t is smoothed to e_t = b0 n_t + b1 e_(t-1) + b2 e_(t-2). The variance v_t of e_t, and the
    covariance c_t of e_t and e_(t-1), satisfy

        v_t = b0^2 + b1^2 v_(t-1) + b2^2 v_(t-2) + 2 b1 b2 c_(t-1),    c_t = b1 v_(t-1) + b2 c_(t-1)
    """
    b0, b1, b2 = smoothing
    variance, covariance = [1.0, 1.0], 0.0
    for _ in range(2, count):
        new = b0 * b0 + b1 * b1 * variance[-1] + b2 * b2 * variance[-2] + 2 * b1 * b2 * covariance
        covariance = b1 * variance[-1] + b2 * covariance
        variance.append(new)
    # positive, because ``fit`` divides by these numbers
    return np.sqrt(np.maximum(variance[:count], np.finfo(np.float32).tiny))
