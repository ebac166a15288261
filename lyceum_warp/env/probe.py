"""Find reads and writes out of range: call a task's functions in one world, with guard memory around its rows."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.core.spaces import Space
from lyceum_warp.core.task import MEMORIES, observer_name
from lyceum_warp.env.arrays import WorldArrays
from lyceum_warp.kernels import step_types
from lyceum_warp.support.arrays import alias, launch_parts, launch_worlds, zeros_of

_ROOM = 2**16
"""Bytes of guard memory before and after every row. A write outside a row changes only guard memory."""

_ALIGNED = 64

_GUARDS = (0x4226A5C3, 0xC215C3E1)
"""Two contents of guard memory: the floats 41.66 and -37.44. If a function reads out of range, its results differ
between them. As indices, these numbers are small enough to stay within guard memory."""

_UNWRITTEN = 0x00010000
"""Bits in which unwritten rows differ from guard memory."""

_RESULTS = {
    "reward": "reward", "eval": "evaluate", "terminated": "terminated", "truncated": "truncated", "success": "success",
}  # fmt: skip
"""Maps the fields of Findings to the functions that write them."""

Results = Iterator[tuple[str, np.ndarray]]
"""The names of functions, each with something that the function wrote."""


class GuardedRows:
    """Holds an array of n rows, with guard memory around each row.

    The rows contain ``values``, or are unwritten; unwritten elements must have 32 bits.
    """

    def __init__(
        self, shape: Sequence[int], dtype: Any, guard: int, device: wp.Device, values: wp.array | None = None
    ) -> None:
        self.size = math.prod(shape[1:])
        self._guard, self._element = guard, wp.types.type_size_in_bytes(dtype)
        self._stride = -(-self.size * self._element // _ALIGNED) * _ALIGNED + _ROOM
        self._memory = wp.full((_ROOM + shape[0] * self._stride) // 4, guard, dtype=wp.uint32, device=device)
        strides = (self._stride, *(self._element * math.prod(shape[i + 1 :]) for i in range(1, len(shape))))
        self.array = alias(self._memory[_ROOM // 4 :], dtype, tuple(shape), strides)
        if self.size and values is None:
            for start in range(_ROOM, self._memory.size * 4 - _ROOM, self._stride):
                self._memory[start // 4 : start // 4 + self.size].fill_(guard ^ _UNWRITTEN)
        elif self.size and values is not None:
            wp.copy(self.array, values)

    def outside(self) -> np.ndarray:
        """Return the indices at which functions wrote outside a row, in ascending order.

        An index before the start of the row is negative.
        """
        words = self._memory.numpy()
        changed = 4 * np.flatnonzero(words != self._guard)[:, None] + np.arange(4)
        guard = np.array([self._guard], dtype=np.uint32).view(np.uint8)
        place = changed[words.view(np.uint8)[changed] != guard] - _ROOM
        index = ((place + _ROOM // 2) % self._stride - _ROOM // 2) // self._element
        return np.unique(index[(index < 0) | (index >= self.size)])

    def words(self) -> np.ndarray:
        """Return a copy of the first row as words of 32 bits, with zeros in place of unwritten elements."""
        words = self._memory.numpy()[_ROOM // 4 : _ROOM // 4 - (-self.size * self._element // 4)]
        return np.where(words == self._guard ^ _UNWRITTEN, np.uint32(0), words)

    def unwritten(self) -> np.ndarray:
        """Return which elements of the first row were not written. The elements must have 32 bits."""
        return self.array.numpy()[0].view(np.uint32) == self._guard ^ _UNWRITTEN


class Probe:
    """Runs the functions of a task in one world. The arrays of the environment stay unchanged.

    It finds what a function does in the world's present state. It does not see an index that leaves one part of memory
    for another part, nor an index of a table in Params.
    """

    def __init__(self, worlds: WorldArrays, world: int = 0) -> None:
        self._worlds, self._world, self._task = worlds, world, worlds.task

    def check_bounds(self) -> None:
        """Raise a ValueError if a function reads or writes out of range."""
        runs = (_Run(self._worlds, self._world, guard).all_functions() for guard in _GUARDS)
        for (function, first), (_, second) in zip(*runs, strict=True):
            if not np.array_equal(first, second, equal_nan=True):
                raise ValueError(
                    f"{function} reads out of range: its result depends on memory beside its arguments, or on elements "
                    "of obs that it has not written"
                )

    def check_observations(self) -> None:
        """Raise a ValueError if a function leaves an element of an observation unwritten, or writes NaN."""
        run = _Run(self._worlds, self._world, _GUARDS[0])
        list(run.judge())
        for group, layout in self._task.layouts.obs.items():
            rows, columns = run.groups[group], np.array(Space.of(layout).columns)
            function = observer_name(group)
            if (unwritten := rows.unwritten()).any():
                raise ValueError(f"{function} leaves {', '.join(columns[unwritten])} of obs unwritten")
            if (bad := np.isnan(rows.array.numpy()[0])).any():
                raise ValueError(f"{function} writes not-a-number into {', '.join(columns[bad])} of obs")


class _Run:
    """One call of each function. The rows of the world have guard memory with the given content."""

    def __init__(self, worlds: WorldArrays, world: int, guard: int) -> None:
        self._worlds, self._world, self._guard = worlds, world, guard
        self._task = task = worlds.task
        self._transition, self._fields = task.kernels.Transition(), dict[str, GuardedRows]()
        self._transition.params, self._transition.weights = self._one(worlds.params), self._one(worlds.weights)
        for name in task.kernels.Batch.vars:
            array = self._one(getattr(worlds.after, name))
            self._fields[name] = self._rows((1, *array.shape[1:]), array.dtype, array)
            setattr(self._transition.after, name, self._fields[name].array)
            before = self._rows((1, *array.shape[1:]), array.dtype, array) if name in MEMORIES else self._fields[name]
            setattr(self._transition.before, name, before.array)
        self._observations, self.groups = task.kernels.Observations(), dict[str, GuardedRows]()
        for group, layout in task.layouts.obs.items():
            self.groups[group] = self._rows((1, sum(layout.values())))
            setattr(self._observations, group, self.groups[group].array)
        self._action = self._rows((1, worlds.action.shape[1]), values=self._one(worlds.action))
        self._ctrl = self._rows((1, task.model.nu), values=self._one(worlds.engine.ctrl))
        self._metrics = self._rows((1, len(task.metrics)))
        self._streams = self._rows((len(self.groups), 1), wp.uint32)
        with wp.ScopedDevice(worlds.device):
            no_sums, self._totals = wp.zeros((1, worlds.sums.size), dtype=float), wp.zeros_like(worlds.sums)
            self._no_fault = wp.zeros(1, dtype=int)
            self._yes, self._no = wp.full(1, True, dtype=bool), wp.full(1, False, dtype=bool)
            self._findings = zeros_of(step_types.Findings, 1, fault=(worlds.judged_parts, 1))
            self._transition.counters = zeros_of(step_types.Counters, 1, rng=(0, 1))
        self._sums = self._rows((1, worlds.sums.size), values=no_sums)
        self._transition.counters.rng = self._streams.array
        self._transition.action = self._action.array

    def _one(self, array: wp.array) -> wp.array:
        """Return the row of the world. A single row belongs to all worlds."""
        return array[self._world : self._world + 1] if array.size and array.shape[0] > 1 else array

    def _rows(self, shape: Sequence[int], dtype: Any = wp.float32, values: wp.array | None = None) -> GuardedRows:
        return GuardedRows(shape, dtype, self._guard, self._worlds.device, values)

    def all_functions(self) -> Results:
        """Call each function, and yield what it wrote. Raise a ValueError if it wrote out of range."""
        kernels, t = self._task.kernels, self._transition
        shared = self._fields.get("shared")
        yield from self.judge()
        if self._task.functions["control"] is not None:
            worlds, fault = self._worlds, wp.clone(self._no_fault)
            action = self._one(worlds.action)
            self._launch(kernels.act, t, action, worlds.ranges, worlds.scale, fault, self._ctrl.array)
            yield self._checked("control", self._ctrl, "ctrl", f"the model has {self._ctrl.size}")
            yield from self._written_fields("control")
        self._launch(kernels.substep_memory, t.after, t.params)
        yield from self._written_fields("substep")
        self._launch(kernels.advance_memory, t)
        yield from self._written_fields("advance")
        if shared is not None:
            declared = f"Sums declares {self._sums.size}"
            self._launch(kernels.tally_worlds, t, self._no_fault, self._sums.array)
            yield self._checked("tally", self._sums, "sums", declared)
            self._launch(kernels.add_tallies, self._sums.array, self._totals, 1)
            self._launch(kernels.share_memory, self._totals, self._sums.array, t.params, shared.array)
            yield self._checked("share", self._sums, "sums", declared)
            yield self._checked("share", shared, "shared", f"Shared declares {shared.size}")
        masks = [wp.clone(self._no) for _ in range(3)]
        self._launch(kernels.run_events, self._no, t, *masks)
        yield from self._written_fields("event")
        self._launch(kernels.start_worlds, self._yes, t)
        yield from self._written_fields("startup")
        for function, random in (("initialize", False), ("randomize", True)):
            self._launch(kernels.restart, self._yes, random, False, t)
            yield from self._written_fields(function)
        rejected = wp.clone(self._no)
        self._launch(kernels.reject_worlds, self._yes, t.after, t.params, rejected)
        yield "reject", rejected.numpy()

    def judge(self) -> Results:
        """Call the functions that judge a transition and observe a state, and yield what each of them wrote."""
        args = [self._yes, self._transition, True, self._no_fault, self._no_fault, self._findings]
        args += [self._metrics.array, self._observations, 1]
        launch_parts(self._task.kernels.judge, 1, 1, args, self._worlds.device)
        for group, rows in self.groups.items():
            yield self._checked(observer_name(group), rows, "", f"obs declares {rows.size}")
        yield "observe", self._streams.words()
        for field, function in _RESULTS.items():
            yield function, getattr(self._findings, field).numpy()
        yield self._checked("measure", self._metrics, "", f"metrics names {list(self._task.metrics)}")

    def _launch(self, kernel: wp.Kernel | None, *args: Any) -> None:
        if kernel is not None:
            launch_worlds(kernel, 1, args, self._worlds.device)

    def _written_fields(self, function: str) -> Results:
        for name in sorted(self._task.writes[function]):
            rows, layout = self._fields[name], self._task.layouts.memory.get(name)
            if not layout:
                yield self._checked(function, rows, name, f"the model has {rows.size}")
            else:  # an index outside of the row most likely leaves its first or its last part
                part = next(iter(layout) if (rows.outside() < 0).all() else reversed(layout))
                start, size = layout[part].start, layout[part].size
                yield self._checked(function, rows, part, f"World declares {size}", start, size)
        yield self._checked(function, self._streams, "rng", "a stream has 1")

    def _checked(
        self, function: str, rows: GuardedRows, target: str, declared: str, start: int = 0, size: int | None = None
    ) -> tuple[str, np.ndarray]:
        size = rows.size if size is None else size
        if (outside := rows.outside() - start).size:
            last = int(outside[-1]) + 1
            # Warp counts negative indices from the end
            text = f"{last} numbers" if last > size else f"at index {int(outside[0]) - size}"
            where = target and f" {'into' if last > size else 'of'} {target}"
            raise ValueError(f"{function} writes {text}{where}, but {declared}")
        return function, rows.words()
