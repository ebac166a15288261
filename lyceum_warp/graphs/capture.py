"""Phases, the parts of a step, a reset or a plan, and graphs of their launches.

Code with launches lists them as phases, in order. ``Graphs.sequence`` turns the list into calls: phases that
follow one another and are made of Warp launches become one graph, captured once and replayed. On an engine whose own
calls are launches a whole step is one graph; on others the engine's calls stay between the graphs.

Warp runs a launch on the CPU in one thread. Beside an engine that steps on all cores, phases that treat every world
apart become several graphs, each for a part of the worlds, and threads replay them side by side.
"""

import contextlib
import dataclasses
import gc
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import torch
import warp as wp

from lyceum_warp.graphs.workers import Workers
from lyceum_warp.support.arrays import part_of_worlds
from lyceum_warp.support.upstream import TILES_ON_CPU, separate_captures, separate_tiles, tiles

Calls = tuple[Callable[[], None], ...]
"""The result of ``Graphs.sequence``: functions to call in order."""


@dataclasses.dataclass(frozen=True)
class Phase:
    """One entry of a list of phases.

    A phase launches the same kernels on the same arrays each time, because a graph holds their addresses and scalar
    arguments.
    """

    name: str
    """Name of the phase's range in a profiler."""
    run: Callable[[], object]
    """Takes no arguments."""
    engine: bool = False
    """True for an engine call, which consists of Warp launches on some engines only."""
    by_world: bool = False
    """Whether all that happens are launches through ``arrays.launch_worlds`` and its relatives, in which no world
    depends on another one, so that several threads may have a part of the worlds each."""


class Graphs:
    """Makes sequences of calls out of phases, and can drop all their graphs.

    Args:
        device: Where the launches run; Warp captures graphs on the CPU, too.
        enabled: False calls every phase directly.
        capture_engine: Whether calls into the engine are made of launches.
        nvtx: Whether to mark each phase as a range for NVIDIA's profilers.
        workers: Threads that replay the graphs of phases with ``by_world``; by default the caller's alone.
    """

    def __init__(
        self, device: wp.Device, *, enabled: bool = True, capture_engine: bool = True, nvtx: bool = False,
        workers: Workers | None = None,
    ) -> None:  # fmt: skip
        self.device, self.enabled, self.capture_engine, self.nvtx = device, enabled, capture_engine, nvtx
        self._workers = workers
        self._graphs: weakref.WeakSet[_Graph] = weakref.WeakSet()

    def sequence(self, phases: Iterable[Phase]) -> Calls:
        """The calls that run some phases in order."""
        calls: list[Callable[[], object]] = []
        together: list[Phase] = []

        def close() -> None:
            if together:
                calls.append(self._captured(*together))
                together.clear()

        for phase in phases:
            if self._is_captured(phase):
                if together and self._workers is not None and together[0].by_world != phase.by_world:
                    close()
                together.append(phase)
                if self.nvtx:
                    close()
            else:
                close()
                calls.append(_Range(phase.name, phase.run) if self.nvtx else phase.run)
        close()
        return tuple(calls)  # type: ignore[arg-type]

    def forget(self) -> None:
        """Drop all graphs, after arrays behind them were replaced; they are captured again when next called."""
        for graph in self._graphs:
            graph.forget()

    def _is_captured(self, phase: Phase) -> bool:
        return self.enabled and (self.capture_engine or not phase.engine)

    def _captured(self, *phases: Phase) -> Callable[[], object]:
        functions = [phase.run for phase in phases]
        graph = _Graph(self.device, functions, self._workers if phases[0].by_world else None)
        self._graphs.add(graph)
        return _Range(phases[0].name, graph) if self.nvtx else graph


SECONDS_A_THREAD = 5e-4
"""Seconds of work that pay for one more thread; to wake it takes some 20 microseconds."""
TIMED = 8
"""Calls of which the shortest counts: other programs interrupt some."""
_CAPTURING = threading.RLock()
"""One capture at a time: controllers and viewers have environments in threads of their own."""
separate_captures()
separate_tiles()


@contextlib.contextmanager
def capturing() -> Iterator[None]:
    """Keep other captures and Python's garbage collection away from a capture.

    A collection may delete graphs of torch that are no longer used. CUDA forbids that while a stream is captured, and
    the capture fails.
    """
    with _CAPTURING:
        collects = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if collects:
                gc.enable()


class _Graph:
    """Functions made of launches as one graph, or as one for each thread where they take long.

    The first call runs them directly, which loads every module that they need; the second captures and replays; all
    further calls replay. Where there are workers, the first of these are timed, and the shortest time decides.
    """

    def __init__(
        self, device: wp.Device, functions: list[Callable[[], object]], workers: Workers | None = None
    ) -> None:
        self._device, self._functions, self._workers = device, functions, workers
        self.forget()

    def forget(self) -> None:
        self._replay: Callable[[], object] | None = None
        self._loaded = False
        self._times: list[float] | None = None if self._workers is None else []

    def __call__(self) -> None:
        if self._replay is None:
            if not self._loaded:
                self._loaded = True
                self._run()
                return
            if self._device.is_cuda:  # a capture may clear memory that earlier launches still work in
                wp.synchronize_device(self._device)
            self._replay = self._capture_part(0, 1)
        if self._times is None:
            self._replay()
            return
        start = time.perf_counter()
        self._replay()
        self._times.append(time.perf_counter() - start)
        if len(self._times) == TIMED:
            shortest, self._times = min(self._times), None
            self._share(shortest)

    def _share(self, seconds: float) -> None:
        """Let workers share the graph, which takes some time alone, as far as that pays off."""
        assert self._workers is not None
        parts = min(self._workers.nthread, int(seconds / SECONDS_A_THREAD))
        if parts > 1:
            self._replay = partial(self._workers.run, [self._capture_part(k, parts) for k in range(parts)])

    def _capture_part(self, part: int, parts: int) -> Callable[[], object]:
        tiles.launched = False
        with capturing(), part_of_worlds(part, parts), wp.ScopedCapture(device=self._device) as capture:
            self._run()
        replay = partial(wp.capture_launch, capture.graph)
        return partial(_alone, replay) if tiles.launched and self._device.is_cpu else replay

    def _run(self) -> None:
        for function in self._functions:
            function()


def _alone(replay: Callable[[], object]) -> None:
    with TILES_ON_CPU:
        replay()


class _Range:
    """A call marked as a range for NVIDIA's profilers."""

    def __init__(self, name: str, call: Callable[[], object]) -> None:
        self._name, self._call = name, call

    def __call__(self) -> None:
        torch.cuda.nvtx.range_push(self._name)
        try:
            self._call()
        finally:
            torch.cuda.nvtx.range_pop()
