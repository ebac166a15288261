"""Step worlds by MuJoCo Warp with results that are reproducible bit for bit on a CUDA device."""

import contextlib
import inspect
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.core.fields import Field
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.engines.deterministic.contact_order import CanonicalOrder
from lyceum_warp.engines.deterministic.sort_memory import LARGEST_BUFFER, Scratch, ScratchSizes
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.engines.warp import forward
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.graphs.capture import capturing

_TIMES_THE_MEMORY = 5
"""This engine's memory per world, divided by the Warp engine's estimate. Measured factors are 4.9 on humanoid, 6.1 on
half_cheetah and 6.3 on hopper. ``prepare_capture`` later measures the memory for the given model."""

_FEW = 256
"""With fewer worlds than this, scratch memory fits on any device and is allocated on demand."""


class DeterministicEngine(WarpEngine):
    """A Warp engine whose steps are reproducible bit for bit on a CUDA device, not only on the CPU.

    The engine sorts contacts and constraint rows, makes MuJoCo Warp sum in a fixed order, and uses the same scratch
    memory for all launches.
    """

    __signature__ = inspect.signature(WarpEngine)  # placement.py reads the options' names here

    partial_refresh = False

    def __init__(self, model: mujoco.MjModel, nworld: int, device: wp.Device, *args: Any, **options: Any) -> None:
        self._scratch = Scratch(device)
        super().__init__(model, nworld, device, *args, **options)
        with wp.ScopedDevice(device):
            self._order = CanonicalOrder(self.m, self.d, self._scratch.open)

    @classmethod
    def bytes_per_world(
        cls, model: mujoco.MjModel, fields: Iterable[Field], dynamics: Iterable[ModelField] = (), **options: Any
    ) -> int:
        return _TIMES_THE_MEMORY * super().bytes_per_world(model, fields, dynamics, **options)

    def bare(self) -> tuple[mjw.Model, mjw.Data]:
        """Make another Data of the same size, and a Model with this engine's arrays, to benchmark MuJoCo Warp alone.

        Their launches do not share scratch memory. A graph of their step therefore takes about a hundred times the
        memory of this engine's graph.
        """
        model, data = super().bare()
        with wp.ScopedDevice(self.device):
            CanonicalOrder(model, data)  # the model's callbacks keep this object alive
        return model, data

    def prepare_capture(self) -> None:
        """Measure the scratch memory that graphs need, and allocate it; this also compiles the kernels of a step."""
        if self.nworld < _FEW:
            return
        sizes = ScratchSizes.probe(self._captured_step)
        if self.nworld > sizes.most:
            raise ValueError(
                f"{self.nworld} worlds are too many for deterministic=True, because a buffer would exceed Warp's limit "
                f"of {LARGEST_BUFFER / 1e9:.3g} GB: use nworld={sizes.most} at most, or omit deterministic"
            )
        fields, dynamics = self.fields.values(), self.dynamics.values()
        plain = super().bytes_per_world(self.model, fields, dynamics, nconmax=self.nconmax, njmax=self.njmax)
        needed = sizes.bytes_of(self.nworld) / self.nworld
        try:
            check_fit(plain + needed, self.nworld, self.device, held=self.nworld * plain)
        except ValueError as error:
            raise ValueError(f"{error}, or omit deterministic=True, which takes most of the memory") from None
        self._scratch.add_block(sizes.bytes_of(self.nworld))

    def _captured_step(self, nworld: int) -> Scratch:
        model, data, scratch = self._put_model(), self._make_data(nworld), Scratch(self.device)
        with wp.ScopedDevice(self.device), scratch.serving():
            CanonicalOrder(model, data, scratch.open)
            forward.step(model, data)
            with capturing(), wp.ScopedCapture(self.device):
                forward.step(model, data)
        return scratch

    def _put_model(self) -> mjw.Model:
        model = super()._put_model()
        model.opt.deterministic = mjw.DeterminismType.ALL
        return model

    @contextlib.contextmanager
    def _on_device(self) -> Iterator[None]:
        with super()._on_device(), self._scratch.serving():
            yield
