"""Capture the phases of a step, a reset or a plan as graphs, and replay them.

``Graphs.sequence`` turns a list of phases into calls. Consecutive phases that consist of Warp launches become one
graph. Other phases, such as a step of the C engine, run between the graphs.

On the CPU, Warp runs each launch in one thread. Phases that process every world independently therefore become several
graphs, one for each part of the worlds, and threads replay the graphs in parallel.
"""

import contextlib
import dataclasses
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import warp as wp

from lyceum_warp.graphs.workers import Workers
from lyceum_warp.support.arrays import part_of_worlds
from lyceum_warp.support.collection import without_collection
from lyceum_warp.support.upstream import TILES_ON_CPU, separate_captures, separate_tiles, tiles

Calls = tuple[Callable[[], None], ...]


@dataclasses.dataclass(frozen=True)
class Phase:
    """One phase of a step, a reset or a plan.

    A phase must launch the same kernels on the same arrays each time, because a graph stores addresses and scalar
    arguments.
    """

    name: str
    """Name of the phase, for ``lyceum_warp.testing``."""
    run: Callable[[], object]
    engine: bool = False
    """Whether the phase calls the physics engine. Graphs can capture the calls of some engines only."""
    by_world: bool = False
    """Whether the worlds can be divided among threads. The phase must launch kernels only through functions such as
    ``arrays.launch_worlds``, and no world may depend on another world."""


class Graphs:
    """Turns phases into sequences of calls, and can discard all captured graphs.

    Args:
        device: Device of the launches; Warp can also capture graphs on the CPU.
        enabled: Whether to capture graphs.
        capture_engine: Whether graphs include the engine's calls. These calls must then only launch kernels.
        workers: Threads that replay the graphs of phases with ``by_world``. By default, the caller's thread is used.
    """

    def __init__(
        self, device: wp.Device, *, enabled: bool = True, capture_engine: bool = True, workers: Workers | None = None
    ) -> None:
        self.device, self.enabled, self.capture_engine = device, enabled, capture_engine
        self._workers = workers
        self._graphs: weakref.WeakSet[_Graph] = weakref.WeakSet()

    def sequence(self, phases: Iterable[Phase]) -> Calls:
        """Turn phases into calls, in order."""
        calls: list[Callable[[], object]] = []
        together: list[Phase] = []

        def close() -> None:
            if together:
                workers = self._workers if together[0].by_world else None
                calls.append(graph := _Graph(self.device, [phase.run for phase in together], workers))
                self._graphs.add(graph)
                together.clear()

        for phase in phases:
            if self.enabled and (self.capture_engine or not phase.engine):
                if together and self._workers is not None and together[0].by_world != phase.by_world:
                    close()
                together.append(phase)
            else:
                close()
                calls.append(phase.run)
        close()
        return tuple(calls)  # type: ignore[arg-type]

    def forget(self) -> None:
        """Discard all graphs because arrays were replaced; the next calls capture new graphs."""
        for graph in self._graphs:
            graph.forget()


SECONDS_A_THREAD = 5e-4
"""Minimum work per thread in seconds; waking a thread takes about 20 microseconds."""
TIMED = 8
"""Number of timed calls. The shortest time is used, because other programs can delay a call."""
_CAPTURING = threading.RLock()
"""Only one thread may capture at a time, but controllers and viewers use environments in separate threads."""
separate_captures()
separate_tiles()


@contextlib.contextmanager
def capturing() -> Iterator[None]:
    """During a capture, exclude other captures, and pause Python's garbage collection.

    Garbage collection may delete unused torch graphs, and a deletion makes a CUDA capture fail.
    """
    with _CAPTURING, without_collection():
        yield


class _Graph:
    """Captures the launches of several functions in one graph. Long work is divided into one graph per thread.

    The first call runs the functions directly, and loads their modules. If there are workers, the first replays are
    timed, and the shortest time determines how many threads share the work.
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
            if self._device.is_cuda:  # a capture may clear memory that running launches still use
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
