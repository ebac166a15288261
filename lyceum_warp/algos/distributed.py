"""Learning in several processes: each steps its share of the worlds, and all make the same update.

A sum over all worlds is a sum over each process's own worlds, then over the processes. Every process draws the random
numbers of all worlds from the same stream and takes those of its own worlds. The number of processes therefore changes
only the rounding of sums.
"""

import contextlib
import os
import weakref
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import distributed

from lyceum_warp.graphs.capture import capturing


class Team:
    """The processes that learn together, and their communication. A team of one process does not communicate.

    All processes must call every method but ``share`` and ``locate``, in the same order.

    Args:
        rank: Number of this process.
        size: Number of processes.
        device: Where this process computes: "cpu", or a CUDA device of its own.
        neighbours: Number of processes on this machine.
    """

    def __init__(self, rank: int = 0, size: int = 1, device: str | None = None, neighbours: int = 1) -> None:
        self.rank, self.size, self.device, self.neighbours = rank, size, device, neighbours
        self._graphs: weakref.WeakSet[torch.cuda.CUDAGraph] = weakref.WeakSet()

    @property
    def leads(self) -> bool:
        """Whether this process writes the files and messages."""
        return self.rank == 0

    @property
    def captures(self) -> bool:
        """Whether a CUDA graph can hold the communication of the processes."""
        return self.size == 1 or distributed.get_backend() == "nccl"

    def capture(self, function: Callable[[], object]) -> torch.cuda.CUDAGraph:
        """Capture calls of torch, and communication, as a CUDA graph; ``release`` resets it."""
        graph = torch.cuda.CUDAGraph()
        # other threads, such as NCCL's, call CUDA during the capture
        with capturing(), torch.cuda.graph(graph, capture_error_mode="thread_local"):
            function()
        self.keep(graph)
        return graph

    def keep(self, graph: torch.cuda.CUDAGraph) -> None:
        """Register a graph for ``release``."""
        self._graphs.add(graph)

    def release(self) -> None:
        """Reset all registered graphs. As long as one exists, NCCL does not shut down."""
        for graph in list(self._graphs):
            graph.reset()

    def share(self, nworld: int) -> int:
        """Number of worlds of each process, of ``nworld`` in all.

        Raises:
            ValueError: ``nworld`` is not a multiple of the number of processes.
        """
        if nworld % self.size:
            raise ValueError(
                f"{self.size} processes cannot share {nworld} worlds evenly: use a multiple of {self.size}"
            )
        return nworld // self.size

    def locate(self, index: torch.Tensor, nworld: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Find samples of all worlds among those of this process's worlds.

        Args:
            index: Places in the flattened (steps, all worlds).
            nworld: Number of this process's worlds.

        Returns:
            Places in the flattened (steps, nworld), 0 for samples of other processes; and whether each sample is one
            of this process.
        """
        step, world = index // (nworld * self.size), index % (nworld * self.size) - self.rank * nworld
        own = (world >= 0) & (world < nworld)
        return (step * nworld + world).masked_fill(~own, 0), own

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        """Sum a tensor over the processes, in place."""
        if self.size > 1:
            distributed.all_reduce(tensor)
        return tensor

    def largest(self, *numbers: int) -> tuple[int, ...]:
        """The largest of the processes' numbers, for each place. Several processes wait for the device."""
        if self.size == 1:
            return numbers
        whole = torch.tensor(numbers, device=self.device)
        distributed.all_reduce(whole, distributed.ReduceOp.MAX)
        return tuple(whole.tolist())

    def gather(self, part: torch.Tensor) -> torch.Tensor:
        """Concatenate the parts of all processes, (size * n, ...) from (n, ...), in every process."""
        if self.size == 1:
            return part
        whole = part.new_empty(self.size * part.shape[0], *part.shape[1:])
        distributed.all_gather(list(whole.chunk(self.size)), part.contiguous())
        return whole

    @torch.no_grad()
    def copy_leader(self, tensors: Iterable[torch.Tensor]) -> None:
        """Overwrite tensors with those of the leading process.

        On equal hardware, parameters that each process updates are equal already.
        On different hardware this prevents rounding errors from adding up.
        """
        if self.size > 1:
            tensors = list(tensors)
            flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
            distributed.broadcast(flat, 0)
            for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
                tensor.copy_(part.view_as(tensor))

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """A block that ends in all processes if it fails in one; only the one that failed reports the error.

        The block itself must not communicate: a process that has failed would not take part.

        Raises:
            SystemExit: The block failed in another process.
        """
        if self.size == 1:
            yield
            return
        failed = torch.zeros(1, device=self.device)
        try:
            yield
        except BaseException:  # signals, too
            self.sum(failed.fill_(1.0))
            raise
        if self.sum(failed).item() > 0:
            raise SystemExit(2)


@contextlib.contextmanager
def side_stream() -> Iterator[None]:
    """A block on another CUDA stream than the default one, as torch needs before a capture of the same calls."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        yield
    torch.cuda.current_stream().wait_stream(stream)


@contextlib.contextmanager
def join(device: str = "cpu") -> Iterator[Team]:
    """The team of the processes that ``torchrun`` started, or a team of this process alone.

    Args:
        device: "cpu", or a CUDA device. Each of several processes takes the GPU of its number on its machine.

    Raises:
        ValueError: There are fewer GPUs than processes on this machine.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1 or "MASTER_ADDR" not in os.environ:
        yield Team(device=device)
        return
    # The first optimizer loads torch's compiler. Loaded within a process group, the compiler would keep the group
    # alive: its threads would still run while Python ends, which now and then aborts the process.
    torch.optim.SGD([torch.zeros(1)])
    place, neighbours = int(os.environ.get("LOCAL_RANK", "0")), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if device.startswith("cuda"):
        if neighbours > torch.cuda.device_count():
            raise ValueError(
                f"{neighbours} processes on this machine need a GPU each, and it has {torch.cuda.device_count()}: "
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
        # After an error NCCL may wait for processes that have ended already, so the group is left to the end of the
        # process. Gloo does not wait, but its threads must end before Python does.
        if clean or distributed.get_backend() == "gloo":
            distributed.destroy_process_group()
