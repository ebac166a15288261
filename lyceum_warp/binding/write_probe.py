"""Find faulty writes of a task's functions: call each function in one world, with guard memory around rows."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.parts import Layout, sizes
from lyceum_warp.core.spaces import Space
from lyceum_warp.core.task import observer_name
from lyceum_warp.kernels import step_types
from lyceum_warp.support.arrays import launch_parts, launch_worlds

_ROOM = 2**18
"""Bytes of guard memory before and after every row. A write outside a row changes only guard memory."""

_ALIGNED = 64

_UNWRITTEN = 0x7FA5C3E1
"""A signaling NaN that marks unwritten memory. Arithmetic turns it into a quiet NaN, so ``+=`` counts as a write."""


class GuardedRows:
    """Holds an array of n rows, with guard memory around each row.

    The rows contain ``_UNWRITTEN``, or the first n rows of ``values``.
    """

    def __init__(self, shape: Sequence[int], dtype: Any, device: wp.Device, values: wp.array | None = None) -> None:
        self.size = math.prod(shape[1:])
        self._element = wp.types.type_size_in_bytes(dtype)
        self._stride = -(-self.size * self._element // _ALIGNED) * _ALIGNED + _ROOM
        words = np.full((_ROOM + shape[0] * self._stride) // 4, _UNWRITTEN, dtype=np.uint32)
        self._memory: wp.array = wp.array(words, dtype=wp.uint32, device=device)
        inner = [self._element * math.prod(shape[axis + 1 :]) for axis in range(1, len(shape))]
        self.array: Any = wp.array(
            ptr=self._memory.ptr + _ROOM, dtype=dtype, shape=tuple(shape), strides=(self._stride, *inner),
            device=device,
        )  # fmt: skip
        if values is not None and values.size:
            wp.copy(self.array, values[: shape[0]])

    def outside(self) -> np.ndarray:
        """Return the indices at which functions wrote outside a row, in ascending order.

        An index before the start of the row is negative.
        """
        words: np.ndarray = self._memory.numpy()
        changed = 4 * np.flatnonzero(words != _UNWRITTEN)[:, None] + np.arange(4)
        unwritten = np.array(_UNWRITTEN, dtype=np.uint32).reshape(1).view(np.uint8)
        place = changed[words.view(np.uint8)[changed] != unwritten] - _ROOM
        offset = (place + _ROOM // 2) % self._stride - _ROOM // 2
        index = offset // self._element
        return np.unique(index[(index < 0) | (index >= self.size)])

    def written(self) -> np.ndarray:
        """Return which elements of the first row were written. The elements must have 32 bits."""
        start = _ROOM // 4
        written: np.ndarray = self._memory.numpy()[start : start + self.size] != _UNWRITTEN
        return written


class Probe:
    """Runs the functions of a task in the first world of a batch. The arrays of the batch stay unchanged."""

    def __init__(self, task: BoundTask, batch: Any, params: wp.array, device: wp.Device) -> None:
        self._name, self._kernels, self._writes, self._params = task.name, task.kernels, task.writes, params
        self._layouts = task.obs_layouts
        self._memory: Mapping[str, Layout] = task.memory
        self._metrics, self._device = list(task.metrics), device
        kernels, nu = task.kernels, task.model.nu
        self._world, self._fields = kernels.Batch(), {}
        written = frozenset[str]().union(*task.writes.values())
        for field in kernels.Batch.vars:
            array = getattr(batch, field)
            if field in written:
                self._fields[field] = self._rows((1, *array.shape[1:]), array.dtype, array)
                array = self._fields[field].array
            setattr(self._world, field, array)
        self._observations, self._groups = kernels.Observations(), {}
        for group, layout in task.obs_layouts.items():
            self._groups[group] = self._rows((1, sum(layout.values())))
            setattr(self._observations, group, self._groups[group].array)
        self._ctrl, self._measured = self._rows((1, nu)), self._rows((1, len(self._metrics)))
        self._streams = self._rows((len(task.obs_layouts), 1), wp.uint32)
        self._sums, self._shared = (
            self._rows((1, sum(sizes(task.shared.get(name, {})).values()))) for name in ("Sums", "Shared")
        )
        with wp.ScopedDevice(self._device):
            self._action = wp.zeros((1, sum((task.actions or {"": nu}).values())), dtype=float)
            self._totals, self._reason = wp.zeros(self._sums.size, dtype=wp.int64), wp.zeros(1, dtype=int)
            self._yes, self._no = wp.full(1, True, dtype=bool), wp.full(1, False, dtype=bool)
            self._counters = step_types.Counters()
            self._counters.step, self._counters.episode = wp.zeros(1, dtype=int), wp.zeros(1, dtype=int)
            self._counters.key = wp.zeros(1, dtype=wp.uint32)
            self._counters.rng = self._streams.array

    def _rows(self, shape: Sequence[int], dtype: Any = wp.float32, values: wp.array | None = None) -> GuardedRows:
        return GuardedRows(shape, dtype, self._device, values)

    def check_bounds(self) -> None:
        """Raise a ValueError if a function writes out of range."""
        kernels, s, p, action, counters = self._kernels, self._world, self._params, self._action, self._counters
        self._observe()
        self._launch(kernels.measure_worlds, s, p, action, self._measured.array)
        self._check("measure", self._measured, "", f"metrics names {self._metrics}")
        self._launch(kernels.control_worlds, s, p, action, self._ctrl.array)
        self._check("control", self._ctrl, "ctrl", f"the model has {self._ctrl.size}")
        self._check_fields("control")
        self._launch(kernels.substep_memory, s, p)
        self._check_fields("substep")
        self._launch(kernels.advance_memory, s, s, p, action, counters)
        self._check_fields("advance")
        self._launch(kernels.tally_worlds, s, s, p, action, self._reason, self._sums.array, self._totals)
        self._check("tally", self._sums, "sums", f"Sums declares {self._sums.size}")
        self._launch(kernels.share_memory, self._totals, self._sums.array, p, self._shared.array)
        self._check("share", self._sums, "sums", f"Sums declares {self._sums.size}")
        self._check("share", self._shared, "shared", f"Shared declares {self._shared.size}")
        masks = [wp.clone(self._no) for _ in range(4)]
        self._launch(kernels.run_events, self._no, s, p, counters, *masks)
        self._check_fields("event")
        self._launch(kernels.start_worlds, self._yes, s, p, counters)
        self._check_fields("startup")
        for function, random in (("initialize", False), ("randomize", True)):
            self._launch(kernels.restart, self._yes, random, False, s, p, counters)
            self._check_fields(function)

    def check_observations(self) -> None:
        """Raise a ValueError if a function writes out of range, leaves an element unwritten, or writes NaN."""
        self._observe()
        for group, rows in self._groups.items():
            written, bad = rows.written(), np.isnan(rows.array.numpy()[0])
            if not written.all():
                raise ValueError(
                    f"{observer_name(group)} of the task {self._name!r} leaves {self._named(group, ~written)} of obs "
                    "unwritten"
                )
            if bad.any():
                raise ValueError(
                    f"{observer_name(group)} of the task {self._name!r} writes not-a-number into "
                    f"{self._named(group, bad)} of obs"
                )

    def _named(self, group: str, chosen: np.ndarray) -> str:
        columns = Space.of(self._layouts[group]).columns
        return ", ".join(columns[i] for i in np.flatnonzero(chosen))

    def _observe(self) -> None:
        finite = wp.zeros((len(self._groups), 1), dtype=bool, device=self._device)
        rows = self._observations
        args = [self._yes, self._world, self._params, self._counters, rows, finite, rows, 1]
        launch_parts(self._kernels.observe_worlds, 1, 1, args, self._device)
        for group, found in self._groups.items():
            self._check(observer_name(group), found, "", f"obs declares {found.size}")

    def _launch(self, kernel: wp.Kernel | None, *args: Any) -> None:
        if kernel is not None:
            launch_worlds(kernel, 1, args, self._device)

    def _check_fields(self, function: str) -> None:
        for name in sorted(self._writes.get(function, ())):
            rows, parts = self._fields[name], self._memory.get(name)
            if parts:  # this finds only writes outside of the row; check_task also finds writes to a wrong part
                self._check_memory(function, rows, parts)
            else:
                self._check(function, rows, name, f"the model has {rows.size}")
        self._check(function, self._streams, "rng", "a stream has 1")

    def _check_memory(self, function: str, rows: GuardedRows, layout: Layout) -> None:
        name = next(iter(layout) if (rows.outside() < 0).all() else reversed(layout))
        start, size = layout[name].start, layout[name].size
        self._check(function, rows, name, f"World declares {size}", start, size)

    def _check(
        self, function: str, rows: GuardedRows, target: str, declared: str, start: int = 0, size: int | None = None
    ) -> None:
        size = rows.size if size is None else size
        if not (outside := rows.outside() - start).size:
            return
        last = int(outside[-1]) + 1
        if last > size:
            text = f"{last} numbers{target and f' into {target}'}"
        else:  # Warp counts negative indices from the end
            text = f"at index {int(outside[0]) - size}{target and f' of {target}'}"
        raise ValueError(f"{function} of the task {self._name!r} writes {text}, but {declared}")
