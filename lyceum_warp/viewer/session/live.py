"""Step the worlds of a session, keep their past, and copy the few rows that a frame shows to the host.

Everything that happens in a step stays on the worlds' device: the past, the returns so far, the points of the curves. A
frame copies the rows that it shows to the host, on a GPU without waiting for them.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from lyceum_warp.done import FAULTS
from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import Pose

HISTORY_BYTES = 240 * 2**20
"""Memory of the past of all worlds, in bytes."""
PLANT_HISTORY_BYTES = 16 * 2**20
"""Memory of the past of a plant, in bytes."""
HISTORY_STEPS = 2000
"""The most steps of the past that are kept."""

_CURVE_ROWS = 512  # points of the curves between two frames; older ones are overwritten
_END, _FAULT = 4, 4  # numbers about the last end of an episode, and about the last fault


class Past:
    """The last steps of all worlds: the state before each step and its action, in buffers of fixed size.

    Position p is the state before step p. Steps before the present can be taken back, and repeated with the same
    actions. Where the memory does not suffice for two states of all worlds, nothing is kept.

    Args:
        env: The worlds.
        limit: Memory in bytes.
        steps: The most steps.
    """

    def __init__(self, env: Env, limit: int = HISTORY_BYTES, steps: int = HISTORY_STEPS) -> None:
        sizes = env.state_space.size, env.action_space.size
        row = env.nworld * (8 * sizes[0] + 4 * sizes[1] + 8)
        places = min(steps, limit // row)
        self.length = places if places > 1 else 0
        """Places for states; 0 where nothing is kept."""
        self.bytes = self.length * row
        device = env.obs.device
        self.states = torch.empty(self.length, env.nworld, sizes[0], dtype=torch.float64, device=device)
        self.actions = torch.empty(self.length, env.nworld, sizes[1], device=device)
        self.returns = torch.empty(self.length, env.nworld, dtype=torch.float64, device=device)
        self.edited: list[bool] = [False] * self.length
        """Whether the state was changed from outside, so that the step before does not lead to it."""
        self.pushed: list[int | None] = [None] * self.length
        """The world in whose state a person's push is."""
        self.now = self.newest = self.oldest = 0

    @property
    def behind(self) -> int:
        """Steps that can be taken back."""
        # the present takes the place of the oldest state as soon as one of them is taken back
        return min(self.now - self.oldest, max(self.length - 1, 0))

    @property
    def ahead(self) -> int:
        """Steps that were taken back, and can be repeated."""
        return self.newest - self.now

    def put(self, state: torch.Tensor, returns: torch.Tensor, *, edited: bool, pushed: int | None) -> int:
        """Keep the present state; returns its place."""
        place = self.now % self.length
        self.states[place].copy_(state)
        self.returns[place].copy_(returns)
        self.edited[place], self.pushed[place] = edited, pushed
        self.oldest = max(self.oldest, self.now - self.length + 1)
        return place

    def drop_ahead(self) -> None:
        """Forget the steps that were taken back."""
        self.newest = self.now


@dataclasses.dataclass(frozen=True)
class Rows:
    """What a frame shows of some worlds, on the host."""

    worlds: tuple[int, ...]
    """Their numbers, the shown one first."""
    states: np.ndarray
    """(worlds, state_space.size) float64."""
    back: np.ndarray
    """Earlier states of the shown world, (burst, state_space.size) float64."""
    back_steps: tuple[int, ...]
    """How many steps each of them lies in the past."""
    episode_return: float
    """Return of the shown world's episode so far."""
    end: tuple[float, float, float, float]
    """The number of the step after which the shown world's last episode ended, the bits of ``Done``, its return and its
    length."""
    fault: tuple[float, float, float, float]
    """The same number of the last fault in any world, the bits, the world, and the number of faults so far."""
    points: np.ndarray
    """New points of the curves, (points, 1 + curves) float64."""
    clock: int
    """Steps since the session began."""


class Live:
    """Worlds that are stepped.

    Args:
        env: The worlds. They stay in the state in which they are.
        limit: Memory of the past in bytes.
    """

    def __init__(self, env: Env, *, limit: int = HISTORY_BYTES) -> None:
        self.env, self.past = env, Past(env, limit)
        self.clock = 0
        """Steps since the session began, without those that were taken back."""
        self.made = 0
        """Steps since the session began, those that were taken back included."""
        self.world = 0
        self.pushed: int | None = None
        """The world in whose state a person's push is."""
        device, n = env.obs.device, env.nworld
        self.asynchronous = device.type != "cpu"
        """Whether rows are copied to the host asynchronously."""
        self.returns = torch.zeros(n, dtype=torch.float64, device=device)
        """Return of each world's episode so far, (nworld,)."""
        self._ends = torch.zeros(n, _END, dtype=torch.float64, device=device)
        self._fault = torch.zeros(_FAULT, dtype=torch.float64, device=device)
        self._ended, self._reward = torch.zeros(n, dtype=torch.bool, device=device), torch.zeros_like(env.reward)
        self._curves = torch.zeros(_CURVE_ROWS, 2 + len(env.metrics), dtype=torch.float64, device=device)
        self._times: list[float] = []
        self._state = env.get_state()
        self._edited = True
        self._reading: _Reading | None = None
        # of the state before the step that is made
        self._length, self._over = env.episode_step.clone(), env.done.clone()
        self._number = torch.arange(n, device=device)

    def warm_up(self) -> None:
        """Make every call a few times, so that their graphs are captured, and restore the state."""
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
        """Make a step, or repeat one that was taken back.

        Args:
            act: Writes the actions of all worlds into ``env.action``. It is not called for a step that is repeated.
        """
        env, past = self.env, self.past
        if past.ahead:
            env.action.copy_(past.actions[past.now % past.length])
            self._before_step()
            env.step()
            past.now += 1
            self._after_step()
            self._edited = False
            if past.edited[place := past.now % past.length]:  # after that step the state was changed from outside
                self._restore(place)
            return
        act()
        self._before_step()
        self._keep(env.get_state(out=self._state))
        env.step()
        self._after_step()

    def expect_steps(self) -> None:
        """Prepare for steps that are made elsewhere, each followed by ``stepped``."""
        self.past.drop_ahead()
        self.env.get_state(out=self._state)
        self._before_step()

    def stepped(self) -> None:
        """A step was made elsewhere, under the actions in ``env.action``."""
        self._keep(self._state)
        self._after_step()
        self.env.get_state(out=self._state)
        self._before_step()

    def _before_step(self) -> None:
        self._length.copy_(self.env.episode_step)
        self._over.copy_(self.env.done)

    def _keep(self, state: torch.Tensor) -> None:
        past = self.past
        if not past.length:
            return
        place = past.put(state, self.returns, edited=self._edited, pushed=self.pushed)
        past.actions[place].copy_(self.env.action)
        past.now += 1
        past.newest = past.now
        self._edited = False

    def _after_step(self) -> None:
        env = self.env
        self.clock += 1
        self.made += 1
        ended, reward = self._ended.copy_(env.done), self._reward.copy_(env.reward)
        if not env.autoreset:  # an end stays set, and the return is that of the episode
            ended.logical_and_(~self._over)
            reward.masked_fill_(self._over, 0.0)
        self.returns.add_(reward)
        # on the CPU it costs nothing to look whether an episode has ended; a GPU would be waited for
        if self.asynchronous or ended.any():
            self._note_ends(ended)
        values = [
            env.reward[self.world],
            env.eval[self.world],
            *(metric[self.world] for metric in env.metrics.values()),
        ]
        self._curves[len(self._times) % _CURVE_ROWS].copy_(torch.stack(values))
        self._times.append(self.clock * env.timestep)

    def _note_ends(self, ended: torch.Tensor) -> None:
        """Note which episodes ended and which worlds had faults, without waiting for the device."""
        env, reason = self.env, self.env.done_reason
        made = torch.full_like(self.returns, self.made)
        end = torch.stack([made, reason.double(), self.returns, self._length + 1.0], dim=1)
        torch.where(ended[:, None], end, self._ends, out=self._ends)
        if env.autoreset:
            self.returns.masked_fill_(ended, 0.0)
        fault = ended & ((reason & int(FAULTS)) != 0)
        # a tensor as the index of an element would be waited for
        first = torch.argmax(fault.to(torch.int8)).view(1)
        count = self._fault[3:] + fault.sum()
        now = torch.cat([made[:1], reason.gather(0, first).double(), first.double(), count])
        torch.where(fault.any(), now, self._fault, out=self._fault)

    # the past

    def back(self, steps: int) -> int:
        """Take steps back; all worlds are then in the states that they were in.

        Returns:
            The number of steps that were taken back: at most those that are kept.
        """
        past = self.past
        steps = min(steps, past.behind)
        if steps <= 0:
            return 0
        if not past.ahead:  # the present has no place yet
            past.put(self.env.get_state(out=self._state), self.returns, edited=self._edited, pushed=self.pushed)
            steps = min(steps, past.behind)
        past.now -= steps
        self.clock -= steps
        self._restore(past.now % past.length)
        self._times.clear()
        return steps

    def _restore(self, place: int) -> None:
        self.env.set_state(self.past.states[place], check=False)
        self.returns.copy_(self.past.returns[place])
        self._edited, self.pushed = self.past.edited[place], self.past.pushed[place]

    # changes from outside

    def reset(self, *, random: bool) -> None:
        """Begin a new episode of the shown world."""
        mask = self._number == self.world
        self.past.drop_ahead()
        if random:
            self.env.rand_reset(mask=mask)
        else:
            self.env.reset(mask=mask)
        self.returns.masked_fill_(mask, 0.0)
        self._edited = True
        if self.pushed == self.world:  # the new state holds no push
            self.pushed = None

    def set_row(self, state: torch.Tensor, *, new_episode: bool = False, world: int | None = None) -> None:
        """Put a world into a state.

        Args:
            state: (state_space.size,) float64, on any device.
            new_episode: Whether its return starts from 0.
            world: Its number; by default that of the shown world.
        """
        world = self.world if world is None else world
        mask = self._number == world
        self.past.drop_ahead()
        states = self.env.get_state()
        states[world].copy_(state)
        self.env.set_state(states, mask, check=False)
        if new_episode:
            self.returns.masked_fill_(mask, 0.0)
        self._edited = True

    def push(self, forces: np.ndarray) -> None:
        """Push bodies of the shown world until another push, or until ``end_push``.

        Args:
            forces: (nbody, 6): force and torque in world coordinates, N and Nm.
        """
        if self.pushed != self.world:
            self.end_push()
        self.write(xfrc_applied=forces)
        self.pushed = self.world

    def end_push(self) -> None:
        """End a push, in the world where it is."""
        if (world := self.pushed) is not None:
            self.pushed = None
            state = self.env.get_state()[world]
            state[self.env.state_space.parts["xfrc_applied"]] = 0.0
            self.set_row(state, world=world)

    def row(self) -> torch.Tensor:
        """The state of the shown world, (state_space.size,) float64, on its device."""
        return self.env.get_state()[self.world]

    def write(self, **parts: np.ndarray) -> None:
        """Change parts of the shown world's state, by their names in ``env.state_space``."""
        state = self.row()
        for name, value in parts.items():
            where = self.env.state_space.parts[name]
            state[where] = torch.as_tensor(np.ascontiguousarray(value).ravel(), dtype=torch.float64).to(state.device)
        self.set_row(state)

    # worlds to show

    def choose(self, choice: int | str) -> int | None:
        """The number of a world; None where the choice names none.

        Args:
            choice: A number, or "next", "previous", "best" and "worst" by the return of the episode so far, or
                "last_ended", the world whose episode ended last. The last three wait for the device.
        """
        n = self.env.nworld
        if choice in ("next", "previous"):
            return (self.world + (1 if choice == "next" else -1)) % n
        if choice == "best":
            return int(self.returns.argmax())
        if choice == "worst":
            return int(self.returns.argmin())
        if choice == "last_ended":
            world = int(self._ends[:, 0].argmax())
            return world if self._ends[world, 0] > 0 else None
        return int(choice) if isinstance(choice, int) and 0 <= choice < n else None

    # rows for the window

    def request(self, worlds: Sequence[int] = (), burst: int = 0) -> None:
        """Begin to copy what a frame shows, unless a copy is on its way.

        Args:
            worlds: Further worlds.
            burst: The number of earlier states of the shown world.
        """
        if self._reading is not None:
            return
        past, device = self.past, self.env.obs.device
        shown = (self.world, *worlds)
        states = self.env.get_state(out=self._state)[_index(shown, device)]
        steps = _spread(past.behind, burst)
        places = _index([(past.now - k) % past.length for k in steps], device)
        points = len(self._times)
        parts = [
            states, past.states[places, self.world], self.returns[self.world : self.world + 1],
            self._ends[self.world], self._fault, self._curves,
        ]  # fmt: skip
        self._reading = _Reading([_to_host(part) for part in parts], shown, steps, self._times[:points], self.clock)
        self._times = []
        if device.type == "cuda":
            self._reading.event = torch.cuda.Event()
            self._reading.event.record()

    def take(self) -> Rows | None:
        """The rows that were requested; None without a request. Waits until they are on the host."""
        reading, self._reading = self._reading, None
        return None if reading is None else reading.rows()


@dataclasses.dataclass
class _Reading:
    """A copy to the host that is on its way."""

    parts: list[torch.Tensor]
    worlds: tuple[int, ...]
    back_steps: tuple[int, ...]
    times: list[float]
    clock: int
    event: Any = None

    def rows(self) -> Rows:
        if self.event is not None:
            self.event.synchronize()
        states, back, returned, end, fault, curves = (part.numpy() for part in self.parts)
        times = self.times[-len(curves) :]
        places = np.arange(len(self.times) - len(times), len(self.times)) % len(curves)
        points = np.column_stack([np.array(times, dtype=float).reshape(-1, 1), curves[places]])
        ends, faults = tuple(end.tolist()), tuple(fault.tolist())
        return Rows(self.worlds, states, back, self.back_steps, float(returned[0]), ends, faults, points, self.clock)


def _index(numbers: Sequence[int], device: torch.device) -> torch.Tensor:
    """Indices on a device, without waiting for it."""
    index = torch.tensor(numbers, dtype=torch.long)
    return index if device.type == "cpu" else index.pin_memory().to(device, non_blocking=True)


def _to_host(part: torch.Tensor) -> torch.Tensor:
    """A copy on the host, which on a GPU is complete only after its event."""
    if part.device.type == "cpu":
        return part.clone()
    host = torch.empty(part.shape, dtype=part.dtype, pin_memory=True)
    return host.copy_(part, non_blocking=True)


def _spread(length: int, count: int) -> tuple[int, ...]:
    """At most ``count`` different numbers from 1 to ``length``, at equal distances."""
    return tuple(sorted({round(i * length / count) for i in range(1, count + 1)} - {0})) if count and length else ()


def pose(state: np.ndarray, parts: Mapping[str, slice], nmocap: int) -> Pose:
    """The pose in a state.

    Args:
        state: (state_space.size,).
        parts: The places of its parts.
        nmocap: Number of mocap bodies.
    """
    none = slice(0, 0)
    position, quaternion = (
        state[parts.get(name, none)].reshape(-1, size)[:nmocap].copy()
        for name, size in (("mocap_pos", 3), ("mocap_quat", 4))
    )
    return Pose(state[parts["qpos"]].copy(), position, quaternion)
