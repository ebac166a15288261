"""Measure the duration of an iteration's phases, and control torch's threads on the CPU."""

import contextlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch

from lyceum_warp.support.settings import temporarily

Result = TypeVar("Result")


class PhaseTimer:
    """Measures the seconds of an iteration's phases, the first of which starts at construction.

    On a GPU, ``mark`` does not wait for the device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.cuda = device, device.type == "cuda"
        self._phases: list[tuple[str, Any, Any]] = []  # with their first and last times, or CUDA events
        self._last = self._now()

    def _now(self) -> Any:
        if not self.cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def mark(self, phase: str = "") -> None:
        """End one phase and start the next. ``seconds`` omits phases without a name."""
        start, self._last = self._last, self._now()
        self._phases.append((phase, start, self._last))

    def seconds(self) -> dict[str, float]:
        """Return the total seconds of each phase ``x`` as ``time_x``, after waiting for the device."""
        if self.cuda:
            self._last.synchronize()
        seconds = {f"time_{phase}": 0.0 for phase, _, _ in self._phases if phase}
        for phase, start, end in self._phases:
            if phase:
                seconds[f"time_{phase}"] += start.elapsed_time(end) * 1e-3 if self.cuda else end - start
        return seconds


def one_thread() -> contextlib.AbstractContextManager[None]:
    """Limit torch to one CPU thread, for operations too small to parallelise.

    On a busy machine, torch's threads would spend more time waiting for each other than computing.
    """
    return temporarily(torch.set_num_threads, 1, torch.get_num_threads())


@contextlib.contextmanager
def beside(function: Callable[[], Result], *, allowed: bool) -> Iterator[Callable[[], Result]]:
    """Run a function and the ``with`` block in parallel if torch has exactly two threads.

    Each then uses one thread. This is faster than running one after the other with two threads each. Mini-batches do
    not benefit from a second thread, and large products speed up by less than a factor of two. If torch has more or
    fewer threads, the function runs when the ``with`` block asks for its result. ``allowed=False`` has the same effect.
    """
    if not allowed or torch.get_num_threads() != 2:
        yield function
        return
    with one_thread(), ThreadPoolExecutor(1) as pool:  # after an error, the pool still waits for the function
        yield pool.submit(function).result
