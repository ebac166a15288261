"""Predictive sampling: planning by the best random rollout.

The planner is that of ``planner.py`` with another update: the sample with the largest return is the new plan. The plan
itself is among the samples, so that a plan is only replaced by a better one. Source: Howell et al. (2022, "Predictive
sampling: real-time behaviour synthesis with MuJoCo"), whose plans are splines with a few knots.
"""

from lyceum_warp.algos.cem import EliteWeights


class BestSample(EliteWeights):
    """The update of predictive sampling."""

    def __init__(self) -> None:
        super().__init__(elites=1)
