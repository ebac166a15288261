"""The cross-entropy method (CEM): planning by a normal distribution that is fitted to the best samples.

The planner is that of ``mppi.py`` with another update. Its noise has a standard deviation s_t for each number of the
plan. From the n best samples (the elites) u_t^1, ..., u_t^n

    u_t = 1/n sum_k u_t^k,    s_t = max(sqrt(1/n sum_k (u_t^k - u_t)^2), min_noise)

are the next plan and its noise. This is the method of Rubinstein (1999, "The cross-entropy method for combinatorial and
continuous optimization") for a normal distribution with a diagonal covariance, as in hydrax, judo and MuJoCo MPC. The
noise moves forward in time with the plan, and its end is filled with the initial noise. Where noise is smoothed
over time, s_t is that of the noise before smoothing: the spread of the elites is divided by what smoothing leaves of
a standard deviation of 1.
"""

from lyceum_warp.algos.mppi import MPPI


class CEM(MPPI):
    """The cross-entropy method: ``lw.CEM(task, ...)`` is ``lw.MPPI(task, update="cem", ...)``.

    The new plan is the mean of the best samples, and their standard deviation becomes that of the noise, which is kept
    between calls and starts again with ``reset``. In the names of other packages:

    ============= =============== ========================
    here          hydrax          judo
    ============= =============== ========================
    ``samples``   num_samples     num_rollouts
    ``elites``    num_elites      num_elites
    ``noise``     sigma_start     at most sigma_max
    ``min_noise`` sigma_min       sigma_min
    ``knots``     num_knots       num_nodes
    ``spline``    spline_type     spline_order
    ============= =============== ========================

    Its arguments are those of ``lw.MPPI``, except ``update``.
    """

    _update = "cem"
