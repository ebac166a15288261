"""Define the interface of plan updates, which weight the samples and may fit parameters to them.

The planner (``planner.py``) rolls out the samples and computes their weighted mean. The modules ``mppi.py``, ``cem.py``
and ``predictive_sampling.py`` implement three updates.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import warp as wp

from lyceum_warp.support.docstrings import document_attributes


@document_attributes
@dataclasses.dataclass(frozen=True)
class PlanSamples:
    """The samples of one improvement of the plans, for an update to read and write.

    Plans and samples have one row per step of the horizon or, with knots, per knot. All tensors are float32 on the
    device of the planner's worlds. The tensors' addresses are fixed, so write into the tensors instead of replacing
    them.
    """

    returns: torch.Tensor
    """The samples' returns, (plants, samples); minus infinity for failed samples."""
    weights: torch.Tensor
    """The samples' weights, (plants, samples). ``weigh`` writes them; they sum to 1 for each plant."""
    actions: torch.Tensor
    """The samples, (rows, plants, samples, nact)."""
    nominal: torch.Tensor
    """The plans around which the planner drew the samples, (rows, plants, nact)."""
    plan: torch.Tensor
    """The new plans, (rows, plants, nact): before ``fit``, the weighted means of the samples."""
    nominal_deviation: torch.Tensor | None
    """Standard deviations of the samples' noise before smoothing, (rows, plants, nact); None without
    ``adapts_noise``."""
    deviation: torch.Tensor | None
    """Standard deviations for the next improvement, written by ``fit``."""
    summary: torch.Tensor
    """Best return, mean return, effective number of samples and number of failed samples, (plants, 4). A capturable
    update writes this tensor in ``weigh``. If the best return is minus infinity, the plan does not change."""


@document_attributes
class PlanUpdate(abc.ABC):
    """Base class of plan updates, which turn samples into the next plan: ``lw.Planner(task, update=MyUpdate(...))``.

    A subclass implements ``weigh``; the new plan is the weighted mean of the samples. A subclass may also implement
    ``fit``, for example to adapt the noise. Each planner uses a shallow copy of the given object, so ``prepare`` may
    store buffers as attributes.
    """

    capturable: ClassVar[bool] = False
    """Whether ``weigh`` and ``fit`` consist of Warp launches on arrays at fixed addresses, so that the planner's graph
    can include both. If False, ``weigh`` and ``fit`` may use torch, and run between two graphs."""
    adapts_noise: ClassVar[bool] = False
    """Whether the noise has a separate standard deviation for each element of a plan. ``fit`` adapts these standard
    deviations, and the planner shifts them in time. If False, the planner's setting ``noise`` applies."""

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
        given = (f"{name}={value!r}" for name, value in vars(self).items() if not name.startswith("_"))
        return f"{type(self).__name__}({', '.join(given)})"


def by_sample(tensor: torch.Tensor) -> Any:
    """Convert a tensor of ``PlanSamples`` to a Warp array, merging the axes of plants and samples."""
    plants = 0 if tensor.ndim == 2 else 1
    return wp.from_torch(tensor.flatten(plants, plants + 1))


def launch_blocks(kernel: wp.Kernel, blocks: int, args: Sequence[Any]) -> None:
    """Launch a kernel with blocks of 256 threads, on the device of its first argument."""
    wp.launch_tiled(kernel, dim=[blocks], inputs=args, block_dim=256, device=args[0].device)
