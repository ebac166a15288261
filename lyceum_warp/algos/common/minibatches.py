"""Run epochs of mini-batches; on a GPU, an epoch is one CUDA graph without host synchronisation."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping

import torch

from lyceum_warp.algos.common.distributed import Captured, Team
from lyceum_warp.algos.common.networks import MLP

Samples = Mapping[str, torch.Tensor]

_SURE = 6.0
"""Room in a process's buffer beyond the mean number of its samples, in standard deviations."""


def room(batch: int, team: Team) -> int:
    """Compute the size of each process's buffer; ``batch`` is the size of a mini-batch over all processes."""
    share = batch / team.size
    return min(batch, math.ceil(share + _SURE * math.sqrt(share)))


class Minibatches:
    """Shuffles a rollout's samples once, and learns from the same mini-batches in every epoch.

    The mini-batches do not depend on the number of processes. The number of samples from one process therefore
    varies between mini-batches. The process copies its samples into a buffer of fixed size, padded with samples of
    weight 0. Samples that do not fit are dropped.

    ``learn`` gets this process's samples and their weights, (samples,). The weights of all processes sum to 1. On a
    GPU, an epoch runs as a CUDA graph, so ``learn`` must update tensors in place.
    """

    def __init__(
        self, learn: Callable[[Samples, torch.Tensor], None], *, steps: int, nworld: int, count: int, team: Team,
        device: torch.device,
    ) -> None:  # fmt: skip
        self.learn, self.team = learn, team
        self.nworld, self.count = nworld, count
        self.samples = steps * nworld * team.size
        self.batch = self.samples // count
        self.room = room(self.batch, team)
        self.weight = torch.zeros(count, self.room, device=device)
        self.order = torch.zeros(count * self.room, dtype=torch.long, device=device)
        self._parts: dict[str, torch.Tensor] = {}
        self.epoch = Captured(self._epoch, team, device)

    @torch.no_grad()
    def shuffle(self, samples: Samples, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Copy samples in random order into mini-batches at fixed addresses.

        The samples have the shape (steps, nworld, ...), and the result (mini-batches, samples, ...). The generator must
        have the same state in every process.
        """
        order = torch.randperm(self.samples, generator=generator, device=self.weight.device)
        places, local = self.team.locate(order[: self.count * self.batch].view(self.count, self.batch), self.nworld)
        if self.room < self.batch:  # put this process's samples first
            first = local.byte().argsort(dim=1, descending=True, stable=True)[:, : self.room]
            places, local = places.gather(1, first), local.gather(1, first)
        self.order.copy_(places.flatten())
        torch.mul(local, 1.0 / self.batch, out=self.weight)
        for name, part in samples.items():
            rows = part.flatten(0, 1)
            if name not in self._parts:
                self._parts[name] = rows.new_empty(self.count, self.room, *rows.shape[1:])
            torch.index_select(rows, 0, self.order, out=self._parts[name].flatten(0, 1))
        return self._parts

    def _epoch(self) -> None:
        for i in range(self.count):
            self.learn({name: rows[i] for name, rows in self._parts.items()}, self.weight[i])


@contextlib.contextmanager
def precision(*, tf32: bool, half: bool = False) -> Iterator[None]:
    """Use TensorFloat-32 for matrix products on a GPU if ``tf32`` is set, and float16 in networks if ``half`` is."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if tf32 else before)
    MLP.in_half = half
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
        MLP.in_half = False
