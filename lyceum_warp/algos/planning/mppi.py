"""Update plans by model predictive path integral control (MPPI): weight samples by the exponential of their returns.

MPPI weights each sample by its return. If sample k of the planner (``planner.py``) has the return R_k, its weight is

    w_k = exp((R_k - max R) / temperature) / sum_j exp((R_j - max R) / temperature),

as in Williams et al., 2017 ("Information theoretic MPC for model-based reinforcement learning"), without a cost on the
controls. A failed sample has the weight 0.
"""

import warp as wp

from lyceum_warp.algos.planning.updates import PlanSamples, PlanUpdate, by_sample, launch_blocks
from lyceum_warp.kernels import planning


class ExponentialWeights(PlanUpdate):
    """Update plans by MPPI.

    Args:
        temperature: Temperature of the weights, in units of reward.
    """

    capturable = True

    def __init__(self, temperature: float) -> None:
        self.temperature = temperature

    def weigh(self, samples: PlanSamples) -> None:
        """Weight samples by exp(return / temperature)."""
        returns, weights = by_sample(samples.returns), by_sample(samples.weights)
        args = [returns, self.temperature, weights, wp.from_torch(samples.summary)]
        launch_blocks(planning.weigh, len(samples.returns), args)
