"""Update plans by predictive sampling: the sample with the largest return becomes the new plan.

The previous plan is one of the samples, so only a better plan can replace it. Predictive sampling was proposed by
Howell et al., 2022 ("Predictive sampling: real-time behaviour synthesis with MuJoCo"), for plans that are splines with
a few knots.
"""

from lyceum_warp.algos.planning.cem import EliteWeights


class BestSample(EliteWeights):
    """Update plans by predictive sampling."""

    def __init__(self) -> None:
        super().__init__(elites=1)
