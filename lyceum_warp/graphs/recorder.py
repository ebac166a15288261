"""Launches recorded once as a graph, and replayed."""

import contextlib
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any

import torch
import warp as wp


class Recorder:
    """Runs functions made of Warp launches, replaying a recording of them from the third call on.

    The first call of a function runs it as it is, which loads every module that it needs; the second records
    it and replays the recording. A function that is called while another one is being recorded becomes part
    of that recording. Recordings hold addresses and scalar arguments: a function must launch the same kernels
    on the same arrays each time.

    Args:
        device: Where the launches run; "cpu" records as CUDA does.
        enabled: False runs every function unrecorded.
        ranges: Names of NVTX ranges for a profiler, by the functions' names; None for no ranges.
    """

    def __init__(self, device: wp.Device, enabled: bool = True, ranges: Mapping[str, str] | None = None) -> None:
        self.device = device
        self.enabled = enabled
        self.ranges = ranges
        self._graphs: dict[Hashable, Any] = {}
        self._recording = False

    def __call__(self, function: Callable[..., None], *args: Hashable) -> None:
        """Run a function, or replay its recording; one recording is kept for each set of arguments."""
        if self.ranges is None or self._recording:
            self._call(function, *args)
        else:
            with self.range(function):
                self._call(function, *args)

    def _call(self, function: Callable[..., None], *args: Hashable) -> None:
        if not self.enabled or self._recording:
            function(*args)
            return
        key = (function, args)
        if key not in self._graphs:
            self._graphs[key] = None
            function(*args)
            return
        if self._graphs[key] is None:
            if self.device.is_cuda:  # what a recording sets aside may be cleared at once: nobody may still work in it
                wp.synchronize_device(self.device)
            self._recording = True
            try:
                with wp.ScopedCapture(device=self.device) as capture:
                    function(*args)
            finally:
                self._recording = False
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    @contextlib.contextmanager
    def range(self, function: Callable[..., None]) -> Iterator[None]:
        """A profiler's range around a function's launches, if there are to be ranges and this one has a name."""
        name = (self.ranges or {}).get(function.__name__)
        if name is None:
            yield
            return
        torch.cuda.nvtx.range_push(name)
        try:
            yield
        finally:
            torch.cuda.nvtx.range_pop()

    def forget(self) -> None:
        """Drop all recordings, after the launches or the arrays behind them have changed."""
        self._graphs.clear()
