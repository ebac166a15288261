"""Several planners on one GPU: each has a CUDA stream, so that one plans while another one's plant takes its step.

A plan of few samples leaves most of a GPU idle. Each planner has a thread. In Warp a device has one current stream for
all threads, so a thread holds ``_TURN`` except while it waits for its plan. Work of other streams disturbs a capture,
so every graph is captured before the threads start.
"""

import concurrent.futures
import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import torch
import warp as wp

import lyceum_warp as lw

_TURN = threading.Lock()
Result = TypeVar("Result")


class StreamPlanner:
    """A planner on a stream of its own; a controller inside of ``run``.

    Args:
        plan: The planner, on a CUDA device.
        plant: What it controls, on the CPU.
    """

    def __init__(self, plan: lw.MPPI, plant: lw.Env) -> None:
        self.plan, self.plant = plan, plant
        self._device = plan.env.device
        self._torch_stream = torch.cuda.Stream(wp.device_to_torch(self._device))
        self._warp_stream = wp.stream_from_torch(self._torch_stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.plan, name)

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, *, shift: int = 1) -> torch.Tensor:
        action = self.plan(state, shift=shift)
        event = torch.cuda.Event(blocking=True)  # other waits occupy a core
        event.record(self._torch_stream)
        _TURN.release()
        try:
            event.synchronize()
        finally:
            _TURN.acquire()
            self._device.set_stream(self._warp_stream, sync=False)
        return action

    def run(self, work: Callable[["StreamPlanner"], Result]) -> Result:
        """Do some work with the planner on its stream. Other threads may work while it waits for a plan."""
        with _TURN, torch.cuda.stream(self._torch_stream):
            before = self._device.stream
            self._device.set_stream(self._warp_stream, sync=False)
            try:
                return work(self)
            finally:
                self._torch_stream.synchronize()
                self._device.set_stream(before, sync=False)


def prepare(planners: Iterable[StreamPlanner]) -> None:
    """Load every module and capture every graph, one planner after the other."""
    for planner in planners:
        planner.run(lambda planner: lw.control(planner.plant, planner, seed=0, steps=3))
        wp.synchronize_device(planner.plan.env.device)


def episodes(planners: Sequence[StreamPlanner], seeds: Iterable[int]) -> list[lw.Trajectory]:
    """An episode for each seed, as many at a time as there are planners, which are prepared."""
    free: queue.SimpleQueue[StreamPlanner] = queue.SimpleQueue()
    for planner in planners:
        free.put(planner)

    def episode(seed: int) -> lw.Trajectory:
        planner = free.get()
        try:
            return planner.run(lambda planner: lw.control(planner.plant, planner, seed=seed))
        finally:
            free.put(planner)

    with concurrent.futures.ThreadPoolExecutor(len(planners)) as threads:
        return list(threads.map(episode, seeds))
