"""Predictive sampling: planning by the best random rollout.

The planner is that of ``mppi.py`` with another update: the sample with the largest return is the new plan. The plan
itself is among the samples, so that a plan is only replaced by a better one. Source: Howell et al. (2022, "Predictive
sampling: real-time behaviour synthesis with MuJoCo"), whose plans are splines with a few knots.
"""

from lyceum_warp.algos.mppi import MPPI


class PredictiveSampling(MPPI):
    """Predictive sampling: ``lw.MPPI`` with ``update="predictive_sampling"``.

    The best sample is the new plan. Howell et al. (2022), hydrax, judo and MuJoCo MPC plan with knots: give ``knots``
    and ``spline``. The arguments are those of ``lw.MPPI``, except ``update``.
    """

    _update = "predictive_sampling"
