"""Seconds of an iteration's phases, and torch's threads on the CPU."""

import contextlib
import time
from collections.abc import Iterator

import torch


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
