"""Seconds of an iteration's phases, and torch's threads on the CPU."""

import contextlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Result = TypeVar("Result")


class PhaseTimer:
    """Measures the seconds between calls of ``mark``; making the timer is the first mark.

    On a GPU a mark is an event in the device's stream: only ``seconds`` waits for the device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.cuda = device, device.type == "cuda"
        self._events: list[torch.cuda.Event] = []
        self._times: list[float] = []
        self.mark()

    def mark(self) -> None:
        """End one phase and begin the next."""
        if self.cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record(torch.cuda.current_stream(self.device))
            self._events.append(event)
        else:
            self._times.append(time.perf_counter())

    def seconds(self) -> list[float]:
        """Duration of each phase; waits until the device has done the last."""
        if not self.cuda:
            return [end - start for start, end in zip(self._times, self._times[1:], strict=False)]
        self._events[-1].synchronize()
        pairs = zip(self._events, self._events[1:], strict=False)
        return [start.elapsed_time(end) * 1e-3 for start, end in pairs]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one CPU thread: operations on one step or one mini-batch are too small to divide.

    On a busy machine torch's threads would wait for each other much longer than they compute.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def beside(function: Callable[[], Result], *, allowed: bool) -> Iterator[Callable[[], Result]]:
    """Call a function while the block runs, each in one of torch's CPU threads, where torch has two.

    Mini-batches gain nothing from a second thread, and large products less than twice. With more threads, with one, or
    where it is not allowed, the function is called when the block asks for its result.

    Args:
        function: The function; the block must not touch what it changes.
        allowed: Whether both may run at the same time.

    Yields:
        What waits for the function's result, and returns it.
    """
    if not allowed or torch.get_num_threads() != 2:
        yield function
        return
    with one_thread(), ThreadPoolExecutor(1) as pool:  # waits for the function, after an error too
        yield pool.submit(function).result
