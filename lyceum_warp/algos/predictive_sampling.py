"""Update plans by predictive sampling: the sample with the largest return becomes the new plan.

The last plan is one of the samples (``planner.py``), so only a better plan replaces the last plan. Howell et al., 2022
("Predictive sampling: real-time behaviour synthesis with MuJoCo") proposed predictive sampling, with splines of a few
knots as plans.
"""

from lyceum_warp.algos.cem import EliteWeights


class BestSample(EliteWeights):
    """Update plans by predictive sampling."""

    def __init__(self) -> None:
        super().__init__(elites=1)
