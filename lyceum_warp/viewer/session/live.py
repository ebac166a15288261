"""Step the worlds of a session, keep their history, and copy the data of a frame to the host.

On a GPU, steps do not wait for the device, and frames are copied to the host asynchronously.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch

from lyceum_warp.done import FAULTS
from lyceum_warp.env import Env

HISTORY_BYTES = 240 * 2**20
"""Memory for the history of all worlds, in bytes."""
PLANT_HISTORY_BYTES = 16 * 2**20
"""Memory for the history of a plant (see ``plant.py``), in bytes."""
HISTORY_STEPS = 2000
"""Maximum number of steps in the history."""

_CURVE_ROWS = 512  # most curve points between two frames; later points overwrite the oldest


class Past:
    """A ring buffer with the states of all worlds before each recent step.

    It stays empty if the memory is too small for two states of all worlds.
    """

    def __init__(self, env: Env, limit: int) -> None:
        n, size, device = env.nworld, env.state_space.size, env.obs.device
        length = min(HISTORY_STEPS, limit // (n * 8 * (size + 1)))
        self.length = length if length > 1 else 0
        self.states = torch.empty(self.length, n, size, dtype=torch.float64, device=device)
        self.returns = torch.empty(self.length, n, dtype=torch.float64, device=device)
        self.pushed: list[int | None] = [None] * self.length
        self.now = self.newest = self.oldest = 0

    @property
    def behind(self) -> int:
        """The number of steps that can be undone."""
        # the first step back replaces the oldest state by the present one
        return min(self.now - self.oldest, max(self.length - 1, 0))

    @property
    def ahead(self) -> int:
        """The number of undone steps that can be redone."""
        return self.newest - self.now

    def put(self, state: torch.Tensor, returns: torch.Tensor, pushed: int | None) -> None:
        """Store the present state."""
        index = self.now % self.length
        self.states[index].copy_(state)
        self.returns[index].copy_(returns)
        self.pushed[index] = pushed
        self.oldest = max(self.oldest, self.now - self.length + 1)

    def drop_ahead(self) -> None:
        """Discard the steps that were undone."""
        self.newest = self.now


@dataclasses.dataclass(frozen=True)
class Rows:
    """The data of a frame, copied to the host."""

    worlds: tuple[int, ...]
    """The indices of the worlds. The displayed world comes first."""
    states: np.ndarray
    """(worlds, state_space.size) float64."""
    back: np.ndarray
    """Earlier states of the displayed world, the latest first, (burst, state_space.size) float64."""
    episode_return: float
    end: tuple[float, ...]
    """The displayed world's last complete episode: its last step, bits of ``Done``, return, length, success."""
    fault: tuple[float, ...]
    """The last fault: its step, bits of ``Done``, the world, and the number of faults so far."""
    points: np.ndarray
    """(points, 2 + curves) float64."""


class Live:
    """Steps worlds, and keeps their history."""

    def __init__(self, env: Env, *, limit: int = HISTORY_BYTES) -> None:
        self.env, self.past = env, Past(env, limit)
        self.made = 0
        self.world = 0
        self.pushed: int | None = None
        device, n = env.obs.device, env.nworld
        self.asynchronous = device.type != "cpu"
        self.returns = torch.zeros(n, dtype=torch.float64, device=device)
        """The return of each world's episode so far, (nworld,)."""
        self._clock = 0  # steps since the session began, except undone ones
        self._ends = torch.zeros(n, 5, dtype=torch.float64, device=device)
        self._fault = torch.zeros(4, dtype=torch.float64, device=device)
        self._ended, self._reward = torch.zeros(n, dtype=torch.bool, device=device), torch.zeros_like(env.reward)
        self._curves = torch.zeros(_CURVE_ROWS, 3 + len(env.metrics), dtype=torch.float64, device=device)
        self._times: list[float] = []
        self._state = env.get_state()
        self._reading: tuple[tuple[int, ...], list[float], list[torch.Tensor]] | None = None  # worlds, times, rows
        self._event = torch.cuda.Event() if device.type == "cuda" else None
        # values before the current step
        self._length, self._over = env.episode_step.clone(), env.done.clone()
        self._number = torch.arange(n, device=device)

    def warm_up(self) -> None:
        """Capture the CUDA graphs that the viewer needs, and restore the state."""
        env = self.env
        before = env.get_state()
        mask = torch.zeros(env.nworld, dtype=torch.bool, device=env.obs.device)
        for _ in range(3):
            env.step()
            env.get_state(out=self._state)
            env.rand_reset(mask=mask)
            env.reset(mask=mask)
            env.set_state(before)

    # steps

    def step(self, act: Callable[[], None]) -> None:
        """Make a step, or redo an undone step.

        Args:
            act: Writes the actions of all worlds into ``env.action``. It is not called to redo a step.
        """
        if self.past.ahead:
            self._move(1)
            return
        act()
        self._before_step()
        self._keep(self.env.get_state(out=self._state))
        self.env.step()
        self._after_step()

    def expect_steps(self) -> None:
        """Prepare for steps that a control loop makes on ``env``. Call ``stepped`` after each of them."""
        self.past.drop_ahead()
        self.env.get_state(out=self._state)
        self._before_step()

    def stepped(self) -> None:
        """Update the history and the statistics after a step that a control loop made."""
        self._keep(self._state)
        self._after_step()
        self.env.get_state(out=self._state)
        self._before_step()

    def _before_step(self) -> None:
        self._length.copy_(self.env.episode_step)
        self._over.copy_(self.env.done)

    def _keep(self, state: torch.Tensor) -> None:
        past = self.past
        if past.length:
            past.put(state, self.returns, self.pushed)
            past.now += 1
            past.newest = past.now

    def _after_step(self) -> None:
        env = self.env
        self._clock += 1
        self.made += 1
        ended, reward = self._ended.copy_(env.done), self._reward.copy_(env.reward)
        if not env.autoreset:  # ``done`` then stays set after the episode, and the return must not grow
            ended.logical_and_(~self._over)
            reward.masked_fill_(self._over, 0.0)
        self.returns.add_(reward)
        # reading the mask would wait for the GPU
        if self.asynchronous or ended.any():
            self._note_ends(ended)
        values = [
            ended[self.world].to(env.reward.dtype),
            env.reward[self.world],
            env.eval[self.world],
            *(metric[self.world] for metric in env.metrics.values()),
        ]
        self._curves[len(self._times) % _CURVE_ROWS].copy_(torch.stack(values))
        self._times.append(self._clock * env.timestep)

    def _note_ends(self, ended: torch.Tensor) -> None:
        env, reason = self.env, self.env.done_reason
        made = torch.full_like(self.returns, self.made)
        end = torch.stack([made, reason.double(), self.returns, self._length + 1.0, env.success.double()], dim=1)
        torch.where(ended[:, None], end, self._ends, out=self._ends)
        if env.autoreset:
            self.returns.masked_fill_(ended, 0.0)
        fault = ended & ((reason & int(FAULTS)) != 0)
        # unlike indexing with a tensor, gather does not wait for the device
        first = torch.argmax(fault.to(torch.int8)).view(1)
        count = self._fault[3:] + fault.sum()
        now = torch.cat([made[:1], reason.gather(0, first).double(), first.double(), count])
        torch.where(fault.any(), now, self._fault, out=self._fault)

    # the history

    def back(self, steps: int) -> int:
        """Restore all worlds to an earlier state, and return how many steps were undone."""
        past = self.past
        if not past.ahead and past.behind:  # the current state is not in the history yet
            past.put(self.env.get_state(out=self._state), self.returns, self.pushed)
        steps = min(steps, past.behind)
        if steps > 0:
            self._move(-steps)
        return steps

    def forward(self, steps: int) -> None:
        """Restore all worlds to a later state that was undone."""
        if steps := min(steps, self.past.ahead):
            self._move(steps)

    def _move(self, steps: int) -> None:
        past = self.past
        past.now += steps
        self._clock += steps
        index = past.now % past.length
        self.env.set_state(past.states[index], check=False)
        self.returns.copy_(past.returns[index])
        self.pushed = past.pushed[index]
        if steps < 0:
            self._times.clear()

    # user requests

    def reset(self, *, random: bool) -> None:
        """Start a new episode of the displayed world."""
        mask = self._number == self.world
        self.past.drop_ahead()
        if random:
            self.env.rand_reset(mask=mask)
        else:
            self.env.reset(mask=mask)
        self.returns.masked_fill_(mask, 0.0)
        if self.pushed == self.world:
            self.pushed = None

    def set_row(self, state: torch.Tensor, *, new_episode: bool = False, world: int | None = None) -> None:
        """Set the state of one world, by default the displayed world.

        Args:
            state: (state_space.size,) float64, on any device.
            new_episode: Whether the world's return starts from 0.
            world: The index of the world.
        """
        world = self.world if world is None else world
        mask = self._number == world
        self.past.drop_ahead()
        states = self.env.get_state()
        states[world].copy_(state)
        self.env.set_state(states, mask, check=False)
        if new_episode:
            self.returns.masked_fill_(mask, 0.0)

    def push(self, forces: np.ndarray) -> None:
        """Push bodies of the displayed world, until ``end_push``.

        Args:
            forces: Forces (N) and torques (Nm) in world coordinates, (nbody, 6).
        """
        if self.pushed != self.world:
            self.end_push()
        self.write(xfrc_applied=forces)
        self.pushed = self.world

    def end_push(self) -> None:
        """Clear the force of a push."""
        if (world := self.pushed) is not None:
            self.pushed = None
            state = self.env.get_state()[world]
            state[self.env.state_space.parts["xfrc_applied"]] = 0.0
            self.set_row(state, world=world)

    def row(self) -> torch.Tensor:
        """Return the state of the displayed world, (state_space.size,) float64, on the world's device."""
        return self.env.get_state()[self.world]

    def write(self, **parts: np.ndarray) -> None:
        """Change parts of the displayed world's state by their names in ``env.state_space``."""
        state = self.row()
        for name, value in parts.items():
            where = self.env.state_space.parts[name]
            state[where] = torch.as_tensor(np.ascontiguousarray(value).ravel(), dtype=torch.float64).to(state.device)
        self.set_row(state)

    # worlds to show

    def choose(self, choice: int | str) -> int:
        """Return the index of the chosen world.

        "best" and "worst" compare the worlds' returns, so they synchronize with the device.
        """
        if isinstance(choice, int):
            return choice
        if choice in ("next", "previous"):
            return (self.world + (1 if choice == "next" else -1)) % self.env.nworld
        return int(self.returns.argmax() if choice == "best" else self.returns.argmin())

    # rows of frames

    def request(self, worlds: Sequence[int] = (), burst: int = 0) -> None:
        """Start to copy the data of a frame to the host, unless a copy is already in progress."""
        if self._reading is not None:
            return
        past, device = self.past, self.env.obs.device
        shown = (self.world, *worlds)
        states = self.env.get_state(out=self._state)[_index(shown, device)]
        count = min(burst, past.behind)
        steps = [past.behind * i // count for i in range(1, count + 1)]
        earlier = _index([(past.now - k) % past.length for k in steps], device)
        parts = [
            states, past.states[earlier, self.world], self.returns[self.world : self.world + 1],
            self._ends[self.world], self._fault, self._curves,
        ]  # fmt: skip
        self._reading, self._times = (shown, self._times, [_to_host(part) for part in parts]), []
        if self._event is not None:
            self._event.record()

    def take(self) -> Rows | None:
        """Wait for the data of the last request."""
        if self._reading is None:
            return None
        (worlds, times, parts), self._reading = self._reading, None
        if self._event is not None:
            self._event.synchronize()
        states, back, returned, end, fault, curves = (part.numpy() for part in parts)
        numbers = np.arange(len(times))[-len(curves) :]
        points = np.column_stack([np.array(times, dtype=float)[numbers], curves[numbers % len(curves)]])
        return Rows(worlds, states, back, float(returned[0]), tuple(end.tolist()), tuple(fault.tolist()), points)


def _index(numbers: Sequence[int], device: torch.device) -> torch.Tensor:
    index = torch.tensor(numbers, dtype=torch.long)
    return index if device.type == "cpu" else index.pin_memory().to(device, non_blocking=True)


def _to_host(part: torch.Tensor) -> torch.Tensor:
    if part.device.type == "cpu":
        return part.clone()
    host = torch.empty(part.shape, dtype=part.dtype, pin_memory=True)
    return host.copy_(part, non_blocking=True)
