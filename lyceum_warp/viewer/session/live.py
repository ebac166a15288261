"""Step the worlds of a session, keep their history, and copy the data of a frame to the host.

On a GPU, only a frame waits for the device, and a step while the mouse pulls a body.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.core import FAULTS
from lyceum_warp.env import Env

HISTORY_BYTES = 240 * 2**20
"""Memory for the history of all worlds, in bytes."""
PLANT_HISTORY_BYTES = 16 * 2**20
"""Memory for the history of a plant (see ``stage.py``), in bytes."""
HISTORY_STEPS = 2000
"""Maximum number of steps in the history, if no episode is longer."""

_CURVE_ROWS = 4096  # maximum number of curve points per frame; further points overwrite the oldest


class Past:
    """A ring buffer with the states of all worlds before each recent step.

    The buffer stays empty if the memory is too small for two states of all worlds.
    """

    def __init__(self, env: Env, limit: int) -> None:
        n, size, device = env.nworld, env.state_space.size, env.obs.device
        length = min(max(HISTORY_STEPS, env.horizon + 1), limit // (n * 8 * (size + 1)))
        self.length = length if length > 1 else 0
        self.states = torch.empty(self.length, n, size, dtype=torch.float64, device=device)
        self.returns = torch.empty(self.length, n, dtype=torch.float64, device=device)
        self.now = self.newest = self.oldest = 0

    @property
    def behind(self) -> int:
        """The number of steps that can be undone."""
        # `back` stores the present state, in place of the oldest state if the buffer is full
        return min(self.now - self.oldest, max(self.length - 1, 0))

    @property
    def ahead(self) -> int:
        """The number of undone steps that can be redone."""
        return self.newest - self.now

    def put(self, state: torch.Tensor, returns: torch.Tensor) -> None:
        """Store the present state."""
        if not self.length:
            return
        index = self.now % self.length
        self.states[index].copy_(state)
        self.returns[index].copy_(returns)
        self.oldest = max(self.oldest, self.now - self.length + 1)

    def drop_ahead(self) -> None:
        """Discard the steps that were undone."""
        self.newest = self.now


@dataclasses.dataclass(frozen=True)
class Rows:
    """The data of a frame, copied to the host."""

    states: np.ndarray
    """States of the displayed world and of other worlds, (worlds, state_space.size) float64."""
    back: np.ndarray
    """Earlier states of the displayed world, the latest first, (burst, state_space.size) float64."""
    episode_return: float
    end: tuple[float, ...] | None
    """The end of the displayed world's last episode: bits of ``Done``, return, length, success. The value is None if no
    episode has ended since the previous frame."""
    fault: tuple[float, ...] | None
    """The last fault: bits of ``Done``, the world, and the number of faults so far. The value is None if no fault has
    occurred since the previous frame."""
    points: np.ndarray
    """The new points of all curves, (points, 2 + curves) float64."""


class Live:
    """Steps worlds, and keeps their history."""

    def __init__(self, env: Env, *, limit: int = HISTORY_BYTES) -> None:
        self.env, self.past = env, Past(env, limit)
        self.steps = self._reported = 0  # number of steps so far, and number of steps before the last frame
        self.world = 0
        self.pull: dict[str, Any] = {}
        """A spring between the mouse and a body of the displayed world, as attributes of a ``mujoco.MjvPerturb``. It
        acts only during steps, so the states of the history and of controllers do not contain it."""
        device, n = env.obs.device, env.nworld
        self.returns = torch.zeros(n, dtype=torch.float64, device=device)
        """The return of each world's episode so far, (nworld,)."""
        self._ends = torch.zeros(n, 5, dtype=torch.float64, device=device)
        self._fault = torch.zeros(4, dtype=torch.float64, device=device)
        self._ended, self._reward = torch.zeros(n, dtype=torch.bool, device=device), torch.zeros_like(env.reward)
        self._curves = torch.zeros(_CURVE_ROWS, 4 + len(env.metrics), dtype=torch.float64, device=device)
        self._points = 0  # number of curve points since the last frame
        self._state = env.get_state()
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

    def step(self) -> None:
        """Make a step with the actions in ``env.action``, or redo an undone step."""
        if self.past.ahead:
            self._move(1)
            return
        env, past = self.env, self.past
        self._length.copy_(env.episode_step)
        self._over.copy_(env.done)
        past.put(env.get_state(out=self._state), self.returns)
        past.now += 1
        past.newest = past.now
        if pulled := bool(self.pull):
            self.write(xfrc_applied=self._forces())
        env.step()
        self._after_step()
        if pulled:
            self.write(xfrc_applied=np.zeros((env.task.model.nbody, 6)))

    def _forces(self) -> np.ndarray:
        """Compute the forces (N) and torques (Nm) of the pull in world coordinates, (nbody, 6)."""
        model, perturb = self.env.task.model, mujoco.MjvPerturb()
        data, state = mujoco.MjData(model), self.env.get_state()[self.world, : self.env.engine.integration_size]
        mujoco.mj_setState(model, data, state.cpu().numpy(), mujoco.mjtState.mjSTATE_INTEGRATION)
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(model, data)
        for name, value in self.pull.items():
            setattr(perturb, name, value)
        mujoco.mjv_applyPerturbForce(model, data, perturb)
        return data.xfrc_applied

    def _after_step(self) -> None:
        env = self.env
        self.steps += 1
        ended, reward = self._ended.copy_(env.done), self._reward.copy_(env.reward)
        if not env.autoreset:  # without resets, ``done`` stays set after the episode, and the return must not grow
            ended.logical_and_(~self._over)
            reward.masked_fill_(self._over, 0.0)
        self.returns.add_(reward)
        # reading the mask would wait for the GPU
        if ended.is_cuda or ended.any():
            self._note_ends(ended)
        point, values = self._curves[self._points % _CURVE_ROWS], (env.reward, env.eval, *env.metrics.values())
        point[0].fill_(self.past.now * env.timestep)
        point[1:].copy_(torch.stack([ended[self.world].to(env.reward.dtype), *(each[self.world] for each in values)]))
        self._points += 1

    def _note_ends(self, ended: torch.Tensor) -> None:
        env, reason = self.env, self.env.done_reason
        steps = torch.full_like(self.returns, self.steps)
        end = torch.stack([steps, reason.double(), self.returns, self._length + 1.0, env.success.double()], dim=1)
        torch.where(ended[:, None], end, self._ends, out=self._ends)
        if env.autoreset:
            self.returns.masked_fill_(ended, 0.0)
        fault = ended & ((reason & int(FAULTS)) != 0)
        # unlike indexing with a tensor, gather does not wait for the device
        first = torch.argmax(fault.to(torch.int8)).view(1)
        count = self._fault[3:] + fault.sum()
        now = torch.cat([steps[:1], reason.gather(0, first).double(), first.double(), count])
        torch.where(fault.any(), now, self._fault, out=self._fault)

    # the history

    def back(self, steps: int) -> int:
        """Undo steps of all worlds, and return how many steps were undone."""
        past = self.past
        if not past.ahead and past.behind:  # the current state is not in the history yet
            past.put(self.env.get_state(out=self._state), self.returns)
        steps = min(steps, past.behind)
        if steps > 0:
            self._move(-steps)
        return steps

    def forward(self, steps: int) -> None:
        """Redo steps that ``back`` has undone."""
        if steps := min(steps, self.past.ahead):
            self._move(steps)

    def _move(self, steps: int) -> None:
        past = self.past
        past.now += steps
        index = past.now % past.length
        self.env.set_state(past.states[index], check=False)
        self.returns.copy_(past.returns[index])
        if steps < 0:
            self._points = 0

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

    def set_row(self, state: torch.Tensor, *, new_episode: bool = False) -> None:
        """Set the state of the displayed world.

        Args:
            state: (state_space.size,) float64, on any device.
            new_episode: Whether the world's return starts from 0.
        """
        states = self.env.get_state()
        states[self.world].copy_(state)
        self._restore(states)
        if new_episode:
            self.returns[self.world] = 0.0

    def write(self, **parts: np.ndarray) -> None:
        """Change parts of the displayed world's state by their names in ``env.state_space``."""
        states = self.env.get_state()
        for name, value in parts.items():
            flat = torch.as_tensor(np.ascontiguousarray(value).ravel(), dtype=torch.float64)
            states[self.world, self.env.state_space.parts[name]] = flat.to(states.device)
        self._restore(states)

    def _restore(self, states: torch.Tensor) -> None:
        self.past.drop_ahead()
        self.env.set_state(states, self._number == self.world, check=False)

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

    # frames

    def rows(self, worlds: Sequence[int] = (), burst: int = 0) -> Rows:
        """Copy the data of a frame to the host, with the states of other worlds and up to ``burst`` earlier states."""
        past = self.past
        states = self.env.get_state(out=self._state)[[self.world, *worlds]]
        count = min(burst, past.behind)
        earlier = [(past.now - past.behind * i // count) % past.length for i in range(1, count + 1)]
        newest = [i % _CURVE_ROWS for i in range(max(0, self._points - _CURVE_ROWS), self._points)]
        self._points = 0
        parts = states, past.states[earlier, self.world], self._ends[self.world], self._fault, self._curves[newest]
        rows, back, end, fault, points = (part.cpu().numpy() for part in parts)
        is_new = end[0] > self._reported, fault[0] > self._reported
        self._reported = self.steps
        return Rows(
            rows, back, self.returns[self.world].item(), tuple(end[1:].tolist()) if is_new[0] else None,
            tuple(fault[1:].tolist()) if is_new[1] else None, points,
        )  # fmt: skip
