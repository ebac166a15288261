"""The arrays of an environment, and the order in which a step's launches follow one another."""

from collections.abc import Callable, Hashable

import torch
import warp as wp

from lyceum_warp.arrays import launch_rows, torch_view
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.done import FAULTS
from lyceum_warp.engines.base import Engine
from lyceum_warp.fields import Stage
from lyceum_warp.graphs.recorder import Recorder
from lyceum_warp.kernels import random, state, steps
from lyceum_warp.spaces import COUNTERS, Space, action_space, control_map, state_space
from lyceum_warp.validate import check_tensor

PHASES = {
    "_begin": "act", "step": "physics", "_judge_step": "judge", "_restart": "restart", "refresh": "refresh",
    "_look": "look", "_judge_state": "judge",
}  # fmt: skip
"""What a profiler calls the functions that a step is made of."""


class Worlds:
    """What ``Env`` is made of: its arrays, and functions made of launches and calls of the engine.

    A function whose launches stay the same is recorded and replayed. On an engine that can be recorded that is
    the whole step; on others the launches between two of the engine's calls.
    """

    nworld: int
    device: wp.Device
    task: BoundTask
    engine: Engine
    action: torch.Tensor
    _horizon: int
    _autoreset: bool
    _record: Recorder

    def _allocate(self) -> None:
        """Make every array; nothing is made after this."""
        n, nu, task, kernels = self.nworld, self.engine.model.nu, self.task.task, self.task.kernels
        self._memory, self._no_memory = wp.zeros((n, task.memory), dtype=float), wp.zeros((n, task.memory), dtype=float)
        self._params = self.task.params_array(self.device)
        # the fields of the state that a step leads to, live, and copies of those that it came from
        self._after, self._before = kernels.Batch(), kernels.Batch()
        self._pairs: list[tuple[wp.array, wp.array]] = []
        for name in self.task.fields:
            live = self._memory if name == "memory" else self.engine.arrays[name]
            self.task.check_field(name, live)
            copy = wp.zeros_like(live)
            setattr(self._after, name, live)
            setattr(self._before, name, copy)
            self._pairs.append((copy, live))

        self.action_space = action_space(self.engine.model, task.action_range)
        self.obs_space = Space.of(self.task.obs_layout)
        self.reward_space = self.eval_space = Space()

        self._out = steps.Outcome()
        for name, dtype in steps.OUTCOMES.items():
            shape = (n, self.obs_space.size) if name in ("obs", "final_obs") else n
            array: wp.array = wp.zeros(shape, dtype=dtype)
            setattr(self._out, name, array)
            setattr(self, name, torch_view(array))
        self._action, self._safe_action = wp.zeros((n, nu), dtype=float), wp.zeros((n, nu), dtype=float)
        self.action = torch_view(self._action)
        ranges, scale = control_map(self.engine.model, task.action_range)
        self._ranges: wp.array = wp.array(ranges, dtype=float)
        self._scale: wp.array = wp.array(scale, dtype=float)

        self._step, self._episode = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
        self._key, self._rng = wp.zeros(n, dtype=wp.uint32), wp.zeros((n, 1), dtype=wp.uint32)
        self._seed = wp.zeros(1, dtype=int)
        self._action_fault, self._no_fault = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
        self._fault_count = wp.zeros(int(FAULTS).bit_length(), dtype=int)
        self._everyone, self._mask = wp.full(n, True, dtype=bool), wp.zeros(n, dtype=bool)
        self._restarting = wp.zeros(n, dtype=bool)
        self._mask_view, self._step_view = torch_view(self._mask), torch_view(self._step)
        self._allocate_state()

    def _allocate_state(self) -> None:
        """Make the state vector, for the fields that the engine keeps in it now."""
        self.state_space = state_space(self.engine.model, self.engine.snapshots, self.task.task.memory)
        self._state = wp.zeros((self.nworld, self.state_space.size), dtype=wp.float64, device=self.device)
        self._state_view = torch_view(self._state)

    def _run(self, function: Callable[..., None], *args: Hashable) -> None:
        """Call a function that calls the engine: as one recording where the engine can be recorded."""
        if self.engine.capturable:
            self._whole(function, *args)
        else:
            function(*args)

    def _whole(self, function: Callable[..., None], *args: Hashable) -> None:
        """Record a function of several phases as one; for a profiler, who asks for ranges, each phase by itself."""
        if self._record.ranges is None:
            self._record(function, *args)
        else:
            function(*args)

    def _physics(self, function: Callable[..., None], *args: Hashable) -> None:
        """Call a function of the engine, as a recording where the engine can be recorded."""
        if self.engine.capturable:
            self._record(function, *args)
        else:
            with self._record.range(function):
                function(*args)

    def _whole_step(self) -> None:
        """One step: the task before physics, physics, the task after it, and new episodes."""
        self._record(self._begin)
        self._physics(self.engine.step, self.task.frame_skip)
        if self.engine.reset_stage == Stage.NONE:
            self._whole(self._finish)
        else:
            self._whole(self._judge_and_restart)
            self._physics(self.engine.refresh, self._restarting)
            self._record(self._look)

    def _begin(self) -> None:
        """Keep the state that the step starts from, and turn actions into controls."""
        kernels = self.task.kernels
        for copy, live in self._pairs:
            wp.copy(copy, live)
        wp.launch(kernels.act, self.nworld, [
            self._after, self._params, self._action, self._ranges, self._scale, self._step, self._safe_action,
            self._action_fault, self.engine.ctrl,
        ], device=self.device)  # fmt: skip

    def _finish(self) -> None:
        self._judge_and_restart()
        self._record(self._look)

    def _judge_and_restart(self) -> None:
        self._record(self._judge_step)
        self._record(self._restart, self._restarting, True)

    def _judge_step(self) -> None:
        """Faults, task memory, reward and ends of a step."""
        kernels = self.task.kernels
        self.engine.find_faults(self._everyone)
        if kernels.remember is not None:
            wp.launch(kernels.remember, self.nworld, [
                self._before, self._after, self._params, self._safe_action, self._step, self._key, self._episode,
                self._rng,
            ], device=self.device)  # fmt: skip
        sticky = not self._autoreset
        self._judge(self._everyone, self.engine.fault, self._action_fault, transition=True, sticky=sticky)
        wp.launch(steps.count_faults, self.nworld, [self.engine.fault, self._fault_count], device=self.device)

    def _judge(
        self, mask: wp.array, fault: wp.array, action_fault: wp.array, *, transition: bool, sticky: bool = False
    ) -> None:
        """Reward, evaluation, ends and observation of the masked worlds; see ``kernels.steps``."""
        wp.launch(self.task.kernels.judge, self.nworld, [
            mask, self._before, self._after, self._params, self._safe_action, self._step, self._horizon, transition,
            sticky, fault, action_fault, self._out, self._restarting,
        ], device=self.device)  # fmt: skip

    def _restart(self, mask: wp.array, randomly: bool) -> None:
        """Put the masked worlds into an initial state of the task."""
        self.engine.reset(mask)
        if self.task.task.memory:
            launch_rows(state.copy_rows, mask, self._no_memory, self._memory)
        wp.launch(self.task.kernels.restart, self.nworld, [
            mask, randomly, self._after, self._params, self._key, self._rng, self._step, self._episode,
        ], device=self.device)  # fmt: skip
        self.engine.commit(mask)

    def _look(self) -> None:
        """Observe the worlds that begin again; the others were observed when they were judged."""
        args = [self._restarting, self._after, self._params, self._out.obs]
        wp.launch(self.task.kernels.look, self.nworld, args, device=self.device)

    def _rehearsal(self) -> None:
        """Everything that an environment launches, unrecorded and in a senseless order."""
        enabled, self._record.enabled = self._record.enabled, False
        try:
            wp.launch(random.seed_worlds, 1, [self._mask, self._seed, 0, self._key, self._episode], device=self.device)
            self._whole_reset(True)
            self._whole_step()
            self._pack()
            self._unpack()
        finally:
            self._record.enabled = enabled

    def _begin_episodes(self, *, randomly: bool) -> None:
        self.action.masked_fill_(self._mask_view[:, None], 0.0)
        self._run(self._whole_reset, randomly)

    def _whole_reset(self, randomly: bool) -> None:
        """Begin episodes in the masked worlds; every getter tells of them afterwards."""
        self._record(self._restart, self._mask, randomly)
        self._physics(self.engine.refresh, self._mask)
        self._record(self._judge_state)

    def _judge_state(self, sticky: bool = False) -> None:
        """Observe and judge the masked worlds where they are, without a transition."""
        # a state that was set unchecked may be unfit: its world shows the last good observation, as after a step
        self.engine.find_faults(self._mask)
        self._judge(self._mask, self.engine.fault, self._no_fault, transition=False, sticky=sticky)

    def _set_mask(self, mask: torch.Tensor | None) -> None:
        if mask is None:
            self._mask_view.fill_(True)
        else:
            check_tensor(mask, "a mask", self._mask_view)
            self._mask_view.copy_(mask)

    def _pack(self) -> None:
        """Gather the state vector."""
        size = self.engine.state_size
        self.engine.get_state(self._state[:, :size])
        # with automatic resets an end is over with the step that it came in, without it stays
        ended = self._no_fault if self._autoreset else self._out.done_reason
        counters = [self._step, self._key, self._episode, ended, self._state[:, size:]]
        wp.launch(state.pack_counters, self.nworld, counters, device=self.device)
        if self.task.task.memory:
            launch_rows(state.widen, self._everyone, self._memory, self._state[:, size + len(COUNTERS) :])

    def _unpack(self) -> None:
        """Put the masked worlds into the state vector's states; every getter tells of them afterwards."""
        size = self.engine.state_size
        self.engine.set_state(self._state[:, :size], self._mask)
        self._record(self._unpack_counters)
        self._record(self._judge_state, not self._autoreset)

    def _unpack_counters(self) -> None:
        size = self.engine.state_size
        counters = [self._mask, self._state[:, size:], self._step, self._key, self._episode, self._out.done_reason]
        wp.launch(state.unpack_counters, self.nworld, counters, device=self.device)
        if self.task.task.memory:
            launch_rows(state.narrow, self._mask, self._state[:, size + len(COUNTERS) :], self._memory)
