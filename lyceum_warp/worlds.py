"""Worlds: the arrays of an environment, and the phases of a step, a reset, and a state that is read or restored.

The order of a step is the list in ``Worlds.step_phases``, and stands nowhere else.
"""

import dataclasses
from functools import partial

import torch
import warp as wp

from lyceum_warp.arrays import launch_rows, torch_view
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.done import FAULTS
from lyceum_warp.engines.base import Engine
from lyceum_warp.fields import Stage
from lyceum_warp.graphs.capture import Calls, Graphs, Phase
from lyceum_warp.kernels import random, state, steps
from lyceum_warp.options import EnvOptions
from lyceum_warp.spaces import COUNTERS, Space, action_space, control_map, state_space
from lyceum_warp.validate import check_tensor


@dataclasses.dataclass(frozen=True)
class Programs:
    """The phases of an environment as calls, for one horizon, one way to reset, and one choice about graphs."""

    graphs: Graphs
    step: Calls
    reset: Calls
    rand_reset: Calls
    read_state: Calls
    restore_state: Calls


def own_bytes_per_world(task: BoundTask) -> int:
    """An estimate of the memory that ``Worlds`` takes for each world beside its engine, in bytes."""
    snapshots = [field for field in task.fields if field.snapshot]
    state_size = state_space(task.model, snapshots, task.task.memory).size
    copies = sum(field.size for field in task.fields)
    return 4 * copies + 8 * state_size + 8 * sum(task.obs_layout.values()) + 200


class Worlds:
    """Many worlds of one task on one engine: arrays of fixed address, and the phases that work on them.

    Every method that a phase names launches the same kernels on the same arrays each time.

    Args:
        task: The task, bound to its model and parameters.
        engine: Its physics, which keeps the task's fields.
        options: Options of the environment.
    """

    def __init__(self, task: BoundTask, engine: Engine, options: EnvOptions) -> None:
        self.task, self.engine, self.device, self.nworld = task, engine, engine.device, engine.nworld
        self.first_world = options.first_world
        with wp.ScopedDevice(self.device):
            self._allocate()
        self._nvtx = options.nvtx
        self._programs: dict[tuple[int, bool, bool], Programs] = {}
        horizon = task.task.horizon if options.horizon is None else options.horizon
        self.configure(horizon=horizon, autoreset=options.autoreset, graphs=options.graphs)

    def _allocate(self) -> None:
        """Make every array; a step, a reset or a restored state makes no other."""
        n, model, task, kernels = self.nworld, self.task.model, self.task.task, self.task.kernels
        # the fields of the state that a step leads to, live, and copies of those of the state before
        self.memory = wp.zeros((n, task.memory), dtype=float)
        self.after, self.before = kernels.Batch(), kernels.Batch()
        self._pairs: list[tuple[wp.array, wp.array]] = []
        for name in self.task.types:
            live = self.memory if name == "memory" else self.engine.arrays[name]
            self.task.check_field(name, live)
            copy = wp.zeros_like(live)
            setattr(self.after, name, live)
            setattr(self.before, name, copy)
            self._pairs.append((copy, live))
        self._no_memory = wp.zeros((n, task.memory), dtype=float)
        self.params = self.task.parameters.array(self.device)

        self.action_space = action_space(model, task.action_range)
        self.obs_space = Space.of(self.task.obs_layout)
        self.state_space = state_space(model, self.engine.snapshots, task.memory)

        self.outcome = steps.Outcome()
        self.buffers: dict[str, torch.Tensor] = {}
        for name, dtype in steps.OUTCOMES.items():
            shape = (n, self.obs_space.size) if name in ("obs", "final_obs") else n
            array: wp.array = wp.zeros(shape, dtype=dtype)
            setattr(self.outcome, name, array)
            self.buffers[name] = torch_view(array)
        nu = self.action_space.size
        self.action, self.safe_action = wp.zeros((n, nu), dtype=float), wp.zeros((n, nu), dtype=float)
        self.buffers["action"] = torch_view(self.action)
        ranges, scale = control_map(model, task.action_range)
        self.ranges: wp.array = wp.array(ranges, dtype=float)
        self.scale: wp.array = wp.array(scale, dtype=float)

        self.steps, self.episode = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
        self.key, self.rng = wp.zeros(n, dtype=wp.uint32), wp.zeros((n, 1), dtype=wp.uint32)
        self._seed = wp.zeros(1, dtype=int)
        self._action_fault, self._no_fault = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
        self.fault_count = wp.zeros(int(FAULTS).bit_length(), dtype=int)
        self.everyone, self.mask = wp.full(n, True, dtype=bool), wp.zeros(n, dtype=bool)
        self.restarting = wp.zeros(n, dtype=bool)
        self.state = wp.zeros((n, self.state_space.size), dtype=wp.float64)
        self.mask_view, self.state_view = torch_view(self.mask), torch_view(self.state)

    def configure(self, *, horizon: int, autoreset: bool, graphs: bool) -> None:
        """Choose the horizon, whether episodes restart automatically, and whether launches become graphs.

        Graphs hold the first two, so each combination has graphs of its own.
        """
        self.horizon, self.autoreset = horizon, autoreset
        key = (horizon, autoreset, graphs)
        if key not in self._programs:
            capture = Graphs(self.device, enabled=graphs, capture_engine=self.engine.capturable, nvtx=self._nvtx)
            self._programs[key] = Programs(
                capture,
                step=capture.sequence(self.step_phases()),
                reset=capture.sequence(self.reset_phases(randomly=False)),
                rand_reset=capture.sequence(self.reset_phases(randomly=True)),
                read_state=capture.sequence(self.read_phases()),
                restore_state=capture.sequence(self.restore_phases()),
            )
        self.programs = self._programs[key]
        self.step = self.programs.step

    # phases

    def step_phases(self) -> list[Phase]:
        """One step, in order."""
        phases = [
            Phase("act", self.act),
            Phase("physics", partial(self.engine.step, self.task.frame_skip), engine=True),
            Phase("judge", self._judge_step),
            Phase("restart", partial(self._restart, self.restarting, randomly=True)),
            Phase("refresh", partial(self.engine.refresh, self.restarting), engine=True),
            Phase("observe", self._observe_restarted),
        ]
        if self.engine.reset_stage == Stage.NONE:  # no field follows from the state
            phases = [phase for phase in phases if phase.name != "refresh"]
        return phases

    def reset_phases(self, *, randomly: bool) -> list[Phase]:
        """New episodes in the worlds of ``mask``, in order."""
        return [
            Phase("restart", partial(self._restart, self.mask, randomly=randomly)),
            Phase("refresh", partial(self.engine.refresh, self.mask), engine=True),
            Phase("judge", self._judge_state),
        ]

    def read_phases(self) -> list[Phase]:
        """Every world's state into ``state``."""
        return [Phase("read state", self._read_state)]

    def restore_phases(self) -> list[Phase]:
        """The worlds of ``mask`` into the states of ``state``, in order; every getter reflects them afterwards."""
        engine_columns = self.state[:, : self.engine.state_size]
        return [
            Phase("restore engine", partial(self.engine.set_state, engine_columns, self.mask), engine=True),
            Phase("restore counters", self._restore_counters),
            Phase("judge", partial(self._judge_state, keep_reason=True)),
        ]

    def rehearsal(self) -> None:
        """Run every phase once, in arbitrary order, to find the kernels that they launch."""
        self.seed_streams(0)
        for phase in (*self.reset_phases(randomly=True), *self.step_phases(), *self.read_phases()):
            phase.run()
        for phase in self.restore_phases():
            phase.run()

    def keep_before(self) -> None:
        """Keep the current state as the one that a transition starts from."""
        for copy, live in self._pairs:
            wp.copy(copy, live)

    def act(self) -> None:
        """Keep the state that the step starts from, and turn actions into controls."""
        self.keep_before()
        wp.launch(self.task.kernels.act, self.nworld, [
            self.after, self.params, self.action, self.ranges, self.scale, self.steps, self.safe_action,
            self._action_fault, self.engine.ctrl,
        ], device=self.device)  # fmt: skip

    def _judge_step(self) -> None:
        """Find faults, advance task memory, and judge the transition."""
        self.engine.find_faults(self.everyone)
        if (advance := self.task.kernels.advance_memory) is not None:
            wp.launch(advance, self.nworld, [
                self.before, self.after, self.params, self.safe_action, self.steps, self.key, self.episode, self.rng,
            ], device=self.device)  # fmt: skip
        keep_reason = not self.autoreset
        self._judge(self.everyone, self.engine.fault, self._action_fault, transition=True, keep_reason=keep_reason)
        wp.launch(steps.count_faults, self.nworld, [self.engine.fault, self.fault_count], device=self.device)

    def _judge(
        self, mask: wp.array, fault: wp.array, action_fault: wp.array, *, transition: bool, keep_reason: bool = False
    ) -> None:
        """Reward, evaluation, ends and observation of the masked worlds; see ``kernels.steps``."""
        wp.launch(self.task.kernels.judge, self.nworld, [
            mask, self.before, self.after, self.params, self.safe_action, self.steps, self.horizon, transition,
            keep_reason, fault, action_fault, self.outcome, self.restarting,
        ], device=self.device)  # fmt: skip

    def _restart(self, mask: wp.array, *, randomly: bool) -> None:
        """Put the masked worlds into an initial state of the task."""
        self.engine.reset(mask)
        if self.task.task.memory:
            launch_rows(state.copy_rows, mask, self._no_memory, self.memory)
        wp.launch(self.task.kernels.restart, self.nworld, [
            mask, randomly, self.after, self.params, self.key, self.rng, self.steps, self.episode,
        ], device=self.device)  # fmt: skip
        self.engine.commit(mask)

    def _observe_restarted(self) -> None:
        """Observe the worlds that restarted; the others were observed when they were judged."""
        args = [self.restarting, self.after, self.params, self.outcome.obs]
        wp.launch(self.task.kernels.observe_worlds, self.nworld, args, device=self.device)

    def _judge_state(self, *, keep_reason: bool = False) -> None:
        """Observe and judge the states of the masked worlds, without a transition."""
        # a state that was set unchecked may be a fault: its world shows the last good observation, as after a step
        self.engine.find_faults(self.mask)
        keep_reason = keep_reason and not self.autoreset
        self._judge(self.mask, self.engine.fault, self._no_fault, transition=False, keep_reason=keep_reason)

    def _read_state(self) -> None:
        size = self.engine.state_size
        self.engine.get_state(self.state[:, :size])
        # with automatic resets an end is over with its step, without them it stays
        ended = self._no_fault if self.autoreset else self.outcome.done_reason
        counters = [self.steps, self.key, self.episode, ended, self.state[:, size:]]
        wp.launch(state.pack_counters, self.nworld, counters, device=self.device)
        if self.task.task.memory:
            launch_rows(state.widen, self.everyone, self.memory, self._memory_columns)

    def _restore_counters(self) -> None:
        self.restore_counters(self.mask, self.state[:, self.engine.state_size :])
        if self.task.task.memory:
            launch_rows(state.narrow, self.mask, self._memory_columns, self.memory)

    @property
    def _memory_columns(self) -> wp.array:
        return self.state[:, self.engine.state_size + len(COUNTERS) :]

    # parts of phases, and preparations, for environments and open-loop rollouts

    def restore_counters(self, mask: wp.array, columns: wp.array) -> None:
        """Set the masked worlds' counters from columns of states."""
        counters = [mask, columns, self.steps, self.key, self.episode, self.outcome.done_reason]
        wp.launch(state.unpack_counters, self.nworld, counters, device=self.device)

    def judge_transition(self, action: torch.Tensor) -> None:
        """Judge the transition from ``before`` to the current state under some actions, without looking for faults."""
        torch_view(self.safe_action).copy_(action)
        self._judge(self.everyone, self._no_fault, self._no_fault, transition=True)

    def seed_streams(self, seed: int) -> None:
        """Restart the random streams of the masked worlds."""
        self._seed.fill_(seed)
        args = [self.mask, self._seed, self.first_world, self.key, self.episode]
        wp.launch(random.seed_worlds, self.nworld, args, device=self.device)

    def set_mask(self, mask: torch.Tensor | None) -> None:
        """Choose the worlds that the next reset or restored state concerns; None for all."""
        if mask is None:
            self.mask_view.fill_(True)
        else:
            check_tensor(mask, "a mask", self.mask_view)
            self.mask_view.copy_(mask)

    def update_params(self) -> None:
        """Bring the parameters of the task into the array that kernels read."""
        changed = self.task.parameters.array(self.device)
        if changed.shape == self.params.shape:
            wp.copy(self.params, changed)
            return
        self.params = changed
        for programs in self._programs.values():
            programs.graphs.forget()
