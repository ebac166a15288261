"""The contract of an update of a plan: weights of the samples, and what is fitted to them.

The planner (``planner.py``) rolls the samples out, averages them by the weights, and does everything else. ``mppi.py``,
``cem.py`` and ``predictive_sampling.py`` are three updates.
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
    """The samples of an improvement and the plans around them, as an update reads and writes them.

    Plans and samples have a row for each step of the horizon or, with knots, for each knot. All tensors are float32, on
    the device of the planner's worlds, and keep their addresses: write into them.
    """

    returns: torch.Tensor
    """The samples' returns, (plants, samples); minus infinity for those that failed."""
    weights: torch.Tensor
    """The samples' weights, (plants, samples), to be written by ``weigh``; those of a plant add up to 1."""
    actions: torch.Tensor
    """The samples, (rows, plants, samples, nact)."""
    nominal: torch.Tensor
    """The plans that the samples vary, (rows, plants, nact)."""
    plan: torch.Tensor
    """The new plans, (rows, plants, nact): before ``fit``, the weighted means of the samples."""
    nominal_deviation: torch.Tensor | None
    """The standard deviations of the samples' noise before smoothing, (rows, plants, nact); None if the update adapts
    none."""
    deviation: torch.Tensor | None
    """The same for the next improvement, to be written by ``fit``."""
    summary: torch.Tensor
    """Best return, mean return, effective number of samples and number of failed samples, (plants, 4). A capturable
    update writes it in ``weigh``. Where the best return is minus infinity, the plan stays as it is."""


@document_attributes
class PlanUpdate(abc.ABC):
    """How a planner makes the next plan of its samples: ``lw.Planner(task, update=MyUpdate(...))``.

    A subclass writes ``weigh``; the new plan is the mean of the samples by these weights. It may also fit something to
    the samples, such as the noise of the next improvement, in ``fit``. Each planner works with a shallow copy of the
    object that it is given, so that ``prepare`` may store buffers as attributes.
    """

    capturable: ClassVar[bool] = False
    """Whether ``weigh`` and ``fit`` consist of Warp launches on arrays of fixed address, which become part of the
    planner's graph. Otherwise they may use torch, and run between two graphs."""
    adapts_noise: ClassVar[bool] = False
    """Whether the noise has a standard deviation for each number of a plan, which moves forward in time with the plan
    and which ``fit`` adapts. Otherwise it is the ``noise`` of the planner's settings."""

    def prepare(self, samples: PlanSamples) -> None:
        """Check the sizes and allocate buffers; called once, when the planner is made."""
        return

    @abc.abstractmethod
    def weigh(self, samples: PlanSamples) -> None:
        """Write ``samples.weights`` from ``samples.returns``."""

    def fit(self, samples: PlanSamples) -> None:
        """Adapt ``samples.deviation``, or change ``samples.plan`` within the actions' bounds; by default nothing."""
        return

    def __repr__(self) -> str:
        """The update with its public attributes, as the planner's ``settings`` show it."""
        given = (f"{name}={value!r}" for name, value in vars(self).items() if not name.startswith("_"))
        return f"{type(self).__name__}({', '.join(given)})"


def by_sample(tensor: torch.Tensor) -> Any:
    """A tensor of ``PlanSamples`` as kernels take it, where one axis counts the samples of all plants."""
    plants = 0 if tensor.ndim == 2 else 1
    return wp.from_torch(tensor.flatten(plants, plants + 1))


def launch_blocks(kernel: wp.Kernel, blocks: int, args: Sequence[Any]) -> None:
    """Launch a kernel with one block of threads for each plant, or for each number of the plans.

    Args:
        kernel: The kernel.
        blocks: Number of blocks.
        args: Its arguments; the first one is an array on the device to launch on.
    """
    wp.launch_tiled(kernel, dim=[blocks], inputs=args, block_dim=256, device=args[0].device)
