"""Update plans by the cross-entropy method (CEM): fit a normal distribution to the best samples.

CEM was proposed by Rubinstein (1999, "The cross-entropy method for combinatorial and continuous optimization"). The
noise has a standard deviation s_t for each element of the plan. The n best samples u_t^1, ..., u_t^n are called elites.
They determine the next plan and the next noise:

    u_t = 1/n sum_k u_t^k,    s_t = max(sqrt(1/n sum_k (u_t^k - u_t)^2), min_noise)

The covariance is diagonal, as in hydrax, judo and MuJoCo MPC. Smoothing multiplies the noise's standard deviation by
``spread``. The elites' standard deviation is therefore divided by ``spread``.
"""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.planning.updates import PlanSamples, PlanUpdate, by_sample, launch_blocks
from lyceum_warp.kernels import planning


class EliteWeights(PlanUpdate):
    """Give the best samples equal weights, and all other samples the weight 0."""

    capturable = True

    def __init__(self, elites: int) -> None:
        self.elites = elites

    def prepare(self, samples: PlanSamples) -> None:
        """Allocate the samples' ranks."""
        self._rank = torch.zeros_like(samples.returns, dtype=torch.int32)

    def weigh(self, samples: PlanSamples) -> None:
        """Give equal weights to the best samples that did not fail."""
        returns, weights, rank = (by_sample(rows) for rows in (samples.returns, samples.weights, self._rank))
        plants, count = samples.returns.shape
        wp.launch(planning.rank, plants * count, [returns, count, rank], device=returns.device)
        args = [returns, rank, self.elites, weights, wp.from_torch(samples.summary)]
        launch_blocks(planning.weigh_elites, plants, args)


class CrossEntropy(EliteWeights):
    """Update plans by CEM.

    Args:
        elites: Number of best samples.
        min_noise: Lower limit of the standard deviations: one number, or one number for each action.
        smoothing: Weights (b0, b1, b2) that smooth the noise over time.
    """

    adapts_noise = True

    def __init__(self, elites: int, min_noise: float | Sequence[float], smoothing: tuple[float, float, float]) -> None:
        super().__init__(elites)
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
        self._smallest, self._spread = (
            torch.as_tensor(row, dtype=torch.float32, device=samples.plan.device)
            for row in (np.full(nact, smallest), spread(self.smoothing, count))
        )

    def fit(self, samples: PlanSamples) -> None:
        """Fit the noise to the elites."""
        weights, actions = by_sample(samples.weights), by_sample(samples.actions)
        plan, before, after = samples.plan, samples.nominal_deviation, samples.deviation
        assert before is not None and after is not None
        rest = [wp.from_torch(t) for t in (plan, self._spread, self._smallest, before, samples.summary, after)]
        launch_blocks(planning.fit_deviation, plan.numel(), [weights, actions, *rest])


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
