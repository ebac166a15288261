"""Learning in several processes: each steps its share of the worlds, and all make the same update.

Sums over all worlds are sums over a process's own worlds, then over the processes. Random numbers for all worlds
are drawn in every process from the same stream, and each takes those of its own worlds. So it makes no difference,
but for the rounding of sums, how many processes there are.
"""

import contextlib
import os
import weakref
from collections.abc import Iterable, Iterator

import torch
from torch import distributed


class Team:
    """The processes that learn together, and what they do with each other; alone, there is nothing to do.

    Every method but ``share`` and ``rows`` has to be called by all of them, in the same order.

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
        """Whether this is the process that writes files and speaks."""
        return self.rank == 0

    @property
    def records(self) -> bool:
        """Whether a CUDA graph can hold what the processes do with each other."""
        return self.size == 1 or distributed.get_backend() == "nccl"

    def hold(self, graph: torch.cuda.CUDAGraph) -> None:
        """Take note of a graph that holds what the processes do with each other, for ``release``."""
        self._graphs.add(graph)

    def release(self) -> None:
        """End all graphs that ``hold`` was told of: NCCL's end waits for them, for ever."""
        for graph in list(self._graphs):
            graph.reset()

    def share(self, nworld: int) -> int:
        """Number of worlds of each process, of ``nworld`` in all.

        Raises:
            ValueError: They cannot be shared out evenly.
        """
        if nworld % self.size:
            raise ValueError(f"{nworld} worlds cannot be shared evenly by {self.size} processes: take a multiple")
        return nworld // self.size

    def rows(self, index: torch.Tensor, nworld: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Where samples of all worlds are among those of this process's worlds.

        Args:
            index: Places in the flattened (steps, all worlds).
            nworld: Number of this process's worlds.

        Returns:
            Places in the flattened (steps, nworld), 0 for samples of other processes, and whether it is an own one.
        """
        step, world = index // (nworld * self.size), index % (nworld * self.size) - self.rank * nworld
        own = (world >= 0) & (world < nworld)
        return (step * nworld + world).masked_fill(~own, 0), own

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        """Sum a tensor over the processes, in place."""
        if self.size > 1:
            distributed.all_reduce(tensor)
        return tensor

    def largest(self, number: int) -> int:
        """The largest of the processes' numbers; several wait for their devices."""
        if self.size == 1:
            return number
        numbers = torch.tensor(number, device=self.device)
        distributed.all_reduce(numbers, distributed.ReduceOp.MAX)
        return int(numbers)

    def gather(self, rows: torch.Tensor) -> torch.Tensor:
        """The rows of all processes, (size * n, ...) from (n, ...), in every process."""
        if self.size == 1:
            return rows
        everyones = rows.new_empty(self.size * rows.shape[0], *rows.shape[1:])
        distributed.all_gather(list(everyones.chunk(self.size)), rows.contiguous())
        return everyones

    @torch.no_grad()
    def follow(self, tensors: Iterable[torch.Tensor]) -> None:
        """Take over the leading process's numbers, in place.

        Parameters that every process updated for itself are the same already where all have the same hardware;
        where they have not, rounding must not let them drift apart.
        """
        if self.size > 1:
            tensors = list(tensors)
            everything = torch.cat([tensor.reshape(-1) for tensor in tensors])
            distributed.broadcast(everything, 0)
            for tensor, part in zip(tensors, everything.split([t.numel() for t in tensors]), strict=True):
                tensor.copy_(part.view_as(tensor))

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """What all processes have to get through: an error in one ends the others, too, and those quietly.

        Within it nobody may do anything else together: a process that has failed would not take part.

        Raises:
            SystemExit: There was an error in another process, which has told of it.
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
def join(device: str = "cpu") -> Iterator[Team]:
    """The team of the processes that ``torchrun`` started, or of this one alone.

    Args:
        device: "cpu", or a CUDA device; each of several processes takes the GPU of its place on its machine.

    Raises:
        ValueError: There are fewer GPUs than processes on this machine.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1 or "MASTER_ADDR" not in os.environ:
        yield Team(device=device)
        return
    # the first optimizer loads torch's compiler, and if there is a group by then, that holds it for ever: its threads
    # would still run while Python ends, which aborts the process now and then
    torch.optim.SGD([torch.zeros(1)])
    place, neighbours = int(os.environ.get("LOCAL_RANK", "0")), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if device.startswith("cuda"):
        if neighbours > torch.cuda.device_count():
            raise ValueError(
                f"{neighbours} processes on this machine want a GPU each, and it has {torch.cuda.device_count()}: "
                "start fewer (torchrun --nproc-per-node), or take --device cpu"
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
        # after an error NCCL may wait in vain for those who are not there any more: the end of the process is the
        # end of its group. Gloo waits for nobody, but its threads must be gone before Python is.
        if clean or distributed.get_backend() == "gloo":
            distributed.destroy_process_group()
