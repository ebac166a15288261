"""Predictive sampling: planning by the best random rollout.

The planner is that of ``mppi.py`` with another update: the sample with the largest return is the new plan. The plan
itself is among the samples, so that a plan is only replaced by a better one. Source: Howell et al. (2022, "Predictive
sampling: real-time behaviour synthesis with MuJoCo"), whose plans are splines with a few knots.
"""

from typing import Any

from lyceum_warp.algos.mppi import MPPI
from lyceum_warp.algos.mppi_arguments import words_of_update
from lyceum_warp.algos.mppi_config import MPPIConfig
from lyceum_warp.task import Task


class PredictiveSampling(MPPI):
    """Predictive sampling: ``lw.MPPI`` with ``update="predictive_sampling"``.

    The best sample is the new plan. Howell et al. (2022), hydrax, judo and MuJoCo MPC plan with knots: give ``knots``
    and ``spline``.

    Args:
        task: Name of a task, a file with one, or its class.
        config: Settings in place of the task's.
        words: The other arguments of ``lw.MPPI``.

    Raises:
        ValueError: An argument is unknown, ambiguous or not valid.
        FileNotFoundError: A model or task file is missing.
    """

    def __init__(self, task: str | type[Task], config: MPPIConfig | None = None, **words: Any) -> None:
        super().__init__(task, config, **words_of_update("predictive_sampling", words))
