"""Distribute learning over processes, which step different worlds and apply the same updates.

Every process generates the random numbers of all worlds, and uses those of its own worlds. The number of processes
therefore affects only the rounding of sums.
"""

import contextlib
import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import distributed

from lyceum_warp.graphs.capture import capturing


class Team:
    """Sums and copies tensors across the processes that learn together.

    All processes must call the methods in the same order. ``neighbours`` is the number of processes on this machine.
    """

    def __init__(self, rank: int = 0, size: int = 1, device: str | None = None, neighbours: int = 1) -> None:
        self.rank, self.size = rank, size
        self.device, self.neighbours = device, neighbours
        self._graphs: weakref.WeakSet[torch.cuda.CUDAGraph] = weakref.WeakSet()

    @property
    def leads(self) -> bool:
        """Whether this process is rank 0, which writes files and messages."""
        return self.rank == 0

    @property
    def captures(self) -> bool:
        """Whether a CUDA graph can capture the communication."""
        return self.size == 1 or distributed.get_backend() == "nccl"

    def capture(self, function: Callable[[], object]) -> torch.cuda.CUDAGraph:
        """Capture a function in a CUDA graph, including its communication."""
        graph = torch.cuda.CUDAGraph()
        # other threads, such as NCCL's, may call CUDA during the capture
        with capturing(), torch.cuda.graph(graph, capture_error_mode="thread_local"):
            function()
        self._graphs.add(graph)
        return graph

    def release(self) -> None:
        """Reset all graphs, because NCCL does not shut down while a graph exists."""
        for graph in list(self._graphs):
            graph.reset()

    def share(self, nworld: int) -> int:
        """Divide ``nworld`` worlds among the processes, and return the number per process.

        Raises:
            ValueError: ``nworld`` is not a multiple of the number of processes.
        """
        if nworld % self.size:
            raise ValueError(
                f"{self.size} processes cannot share {nworld} worlds evenly: use a multiple of {self.size}"
            )
        return nworld // self.size

    def locate(self, index: torch.Tensor, nworld: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Convert indices of the samples of all processes to indices of this process's samples.

        The arrays of samples have the shapes (steps, worlds of all processes) and (steps, nworld).

        Returns:
            The indices, and a mask of this process's samples. Samples of other processes get the index 0.
        """
        step, world = index // (nworld * self.size), index % (nworld * self.size) - self.rank * nworld
        local = (world >= 0) & (world < nworld)
        return (step * nworld + world).masked_fill(~local, 0), local

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        """Sum a tensor over the processes, in place."""
        if self.size > 1:
            distributed.all_reduce(tensor)
        return tensor

    def largest(self, *numbers: int) -> tuple[int, ...]:
        """Compute the elementwise maximum over the processes."""
        if self.size == 1:
            return numbers
        maxima = torch.tensor(numbers, device=self.device)
        distributed.all_reduce(maxima, distributed.ReduceOp.MAX)
        return tuple(maxima.tolist())

    def gather(self, part: torch.Tensor) -> torch.Tensor:
        """Concatenate the tensors (n, ...) of all processes into a tensor (size * n, ...)."""
        if self.size == 1:
            return part
        rows = part.new_empty(self.size * part.shape[0], *part.shape[1:])
        distributed.all_gather(list(rows.chunk(self.size)), part.contiguous())
        return rows

    @torch.no_grad()
    def copy_leader(self, tensors: Iterable[torch.Tensor]) -> None:
        """Broadcast tensors from rank 0, in place.

        Otherwise, rounding errors would make processes on different hardware drift apart.
        """
        if self.size > 1:
            tensors = list(tensors)
            vector = flatten(tensors)
            distributed.broadcast(vector, 0)
            for tensor, part in zip(tensors, unflatten(vector, tensors), strict=True):
                tensor.copy_(part)

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """End all processes if the ``with`` block raises an error in one of them.

        Code in the ``with`` block must not communicate with other processes. Otherwise, an error in one process would
        make the others hang.

        Raises:
            SystemExit: The ``with`` block failed in another process.
        """
        if self.size == 1:
            yield
            return
        failed = torch.zeros(1, device=self.device)
        try:
            yield
        except BaseException:  # including signals
            self.sum(failed.fill_(1.0))
            raise
        if self.sum(failed).item() > 0:
            raise SystemExit(2)


def flatten(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """Concatenate tensors into one vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def unflatten(vector: torch.Tensor, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Split a vector into views with the shapes of ``tensors``."""
    parts = vector.split([tensor.numel() for tensor in tensors])
    return [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]


class Captured:
    """Calls a function that runs torch operations and communicates with other processes.

    On a GPU, a CUDA graph replays the function. The function must update tensors in place, because a graph stores
    addresses. The first call runs the function directly.
    """

    def __init__(self, function: Callable[[], object], team: Team, device: torch.device) -> None:
        self.function, self.team, self.device = function, team, device
        self.enabled = device.type == "cuda" and team.captures
        self.forget()

    def forget(self) -> None:
        """Discard the graph; call this after replacing a tensor that the graph uses."""
        self._warm = False
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Call the function, or replay its graph."""
        if not self.enabled:
            self.function()
            return
        with torch.cuda.device(self.device):
            if not self._warm:
                # before a capture, torch requires one call on a stream other than the default stream
                current, side = torch.cuda.current_stream(), torch.cuda.Stream()
                side.wait_stream(current)
                with torch.cuda.stream(side):
                    self.function()
                current.wait_stream(side)
                self._warm = True
                return
            if self.graph is None:
                self.graph = self.team.capture(self.function)
            self.graph.replay()


class Branch:
    """Runs the kernels of a ``with`` block on a second CUDA stream, beside those that follow until ``join``.

    Backward passes run on the streams of their forward passes. On a CPU, this does nothing.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._entered = torch.cuda.StreamContext(self.stream)

    def __enter__(self) -> None:
        if self.stream is not None:
            self.stream.wait_stream(torch.cuda.current_stream(self.stream.device))
        self._entered.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._entered.__exit__(*error)

    def join(self) -> None:
        """Let the current stream wait for the second stream."""
        if self.stream is not None:
            torch.cuda.current_stream(self.stream.device).wait_stream(self.stream)


@contextlib.contextmanager
def join(device: str = "cpu") -> Iterator[Team]:
    """Join the processes that ``torchrun`` started.

    Args:
        device: "cpu", or a CUDA device. If there are several processes, each uses the GPU of its local rank.

    Raises:
        ValueError: There are fewer GPUs than processes on this machine.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1 or "MASTER_ADDR" not in os.environ:
        yield Team(device=device)
        return
    place, neighbours = int(os.environ.get("LOCAL_RANK", "0")), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if device.startswith("cuda"):
        if neighbours > torch.cuda.device_count():
            raise ValueError(
                f"{neighbours} processes on this machine need one GPU each, but the machine has "
                f"{torch.cuda.device_count()}: "
                "start fewer (torchrun --nproc-per-node), or use --device cpu"
            )
        device = f"cuda:{place}"
        torch.cuda.set_device(place)
        distributed.init_process_group("nccl", device_id=torch.device(device))
    else:
        distributed.init_process_group("gloo")
    team, clean = Team(distributed.get_rank(), size, device, neighbours), False
    try:
        yield team
        clean = True
    finally:
        team.release()
        # After an error, NCCL might wait for processes that have exited. Gloo does not wait, and its threads must end
        # before Python exits.
        if clean or distributed.get_backend() == "gloo":
            distributed.destroy_process_group()
