"""Define the interface of plan updates, which turn samples into the next plan.

The planner (``planner.py``) rolls out the samples and computes their weighted mean.
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


@document_attributes
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
        given = (f"{name}={value!r}" for name, value in vars(self).items() if not name.startswith("_"))
        return f"{type(self).__name__}({', '.join(given)})"


def by_sample(tensor: torch.Tensor) -> Any:
    """Convert a tensor of ``PlanSamples`` to a Warp array, with the axes of plants and samples merged."""
    plants = 0 if tensor.ndim == 2 else 1
    return wp.from_torch(tensor.flatten(plants, plants + 1))


def launch_blocks(kernel: wp.Kernel, blocks: int, args: Sequence[Any]) -> None:
    """Launch a kernel with blocks of 256 threads, on the device of its first argument."""
    wp.launch_tiled(kernel, dim=[blocks], inputs=args, block_dim=256, device=args[0].device)
