"""Worlds: the arrays of an environment, and the phases of a step, a reset, and a state that is read or restored.

The order of a step is the list in ``Worlds.step_phases``, and stands nowhere else.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.arrays import (
    flat,
    launch_lanes,
    launch_parts,
    launch_rows,
    launch_worlds,
    shared_rows,
    torch_view,
    with_memory,
)
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.done import FAULTS
from lyceum_warp.engines.base import Engine
from lyceum_warp.fields import Stage
from lyceum_warp.graphs.capture import Calls, Graphs, Phase
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.kernels import random, rows, state, steps
from lyceum_warp.options import EnvOptions
from lyceum_warp.spaces import Space, action_space, control_ranges, control_scale, state_space
from lyceum_warp.task import MEMORIES
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
    state_size = state_space(task.model, snapshots, task.dynamics, own_parts(task)).size
    copies = sum(field.size for field in task.fields)
    observations = sum(sum(layout.values()) for layout in task.obs_layouts.values())
    return 4 * copies + 8 * state_size + 8 * observations + 300


def own_parts(task: BoundTask) -> dict[str, int]:
    """The parts of a state that ``Worlds`` keeps beside the counters, and their sizes."""
    form = task.task
    sizes = {name: getattr(form, name) for name in MEMORIES}
    sizes |= {"metrics": len(form.metrics), "success_steps": int(form.success_steps > 1)}
    return {name: size for name, size in sizes.items() if size}


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
        self._workers = self._make_workers()
        self._programs: dict[tuple[int, bool, bool], Programs] = {}
        horizon = task.task.horizon if options.horizon is None else options.horizon
        self.configure(horizon=horizon, autoreset=options.autoreset, graphs=options.graphs)

    def _allocate(self) -> None:
        """Make every array; a step, a reset or a restored state makes no other."""
        n, model, task, kernels = self.nworld, self.task.model, self.task.task, self.task.kernels
        self.memory = wp.zeros((n, task.memory), dtype=float)
        self.lasting_memory = wp.zeros((n, task.lasting_memory), dtype=float)
        self._lasting_before = wp.zeros((n, task.lasting_memory), dtype=float)
        self.metric_sums = wp.zeros((n, len(task.metrics)), dtype=float)
        """Sums of the metrics over the episode so far."""
        self.success_counts = wp.zeros((n, int(task.success_steps > 1)), dtype=float)
        """Steps in a row with the goal met, up to ``success_steps``; without a column where one step is enough."""
        own = ("memory", "lasting_memory", "metric_sums", "success_counts")
        self._clearable = {name: getattr(self, name) for name in own}
        self._clearable |= {name: flat(self.engine.arrays[name]) for name in task.cleared}
        self._zeros = wp.zeros(max(array.shape[1] for array in self._clearable.values()), dtype=float)
        # the fields of the state that a step leads to, live, and copies of those of the state before
        self.after, self.before = kernels.Batch(), kernels.Batch()
        self._copies: dict[str, wp.array] = {}
        constant = {f.name: shared_rows(f.value(model), f.dtype, n, self.device) for f in self.task.constants}
        varied = [field.name for field in self.task.dynamics]
        for name in self.task.types:
            live: Any = getattr(self, name) if name in MEMORIES else constant.get(name, self.engine.arrays.get(name))
            self.task.check_field(name, live)
            live = with_memory(live)
            setattr(self.after, name, live)
            if live.size and name not in constant and name not in varied:  # no step changes the model
                self._copies[name] = wp.zeros_like(live)
            setattr(self.before, name, self._copies.get(name, live))
        self.fields = {**self.engine.arrays, **constant}
        """The arrays of all fields of the engine and the model, (nworld, ...), by name."""
        drawn = [f.name for f in self.task.dynamics if f.name in self.task.writes.get("event", ())]
        self._model_copies = {name: wp.zeros_like(self.engine.arrays[name]) for name in drawn}
        self.params = self.task.parameters.array(self.device)

        self.action_space = action_space(model, task.action_range, task.actions)
        self.obs_spaces = {group: Space.of(layout) for group, layout in self.task.obs_layouts.items()}
        self.state_space = state_space(model, self.engine.snapshots, self.task.dynamics, own_parts(self.task))

        self.outcome = steps.Outcome()
        self.buffers: dict[str, torch.Tensor] = {}
        for name, dtype in steps.OUTCOMES.items():
            setattr(self.outcome, name, wp.zeros(n, dtype=dtype))
            self.buffers[name] = torch_view(getattr(self.outcome, name))
        self.metrics: wp.array = wp.zeros((n, len(task.metrics)), dtype=float)
        """The metrics of the last step, (nworld, number of metrics)."""
        self.episode_metrics: wp.array = wp.zeros_like(self.metrics)
        """Their sums over the episode of that step."""
        self.outcome.metrics = self.metrics  # type: ignore[assignment]
        self.outcome.episode_metrics = self.episode_metrics  # type: ignore[assignment]
        parts = int(steps.OBSERVE_FIRST) + len(self.obs_spaces)
        self._judging = parts if self.device.is_cuda else 1  # threads that judge a world
        self._found = steps.Findings()
        self._found.reward, self._found.eval = wp.zeros(n, dtype=float), wp.zeros(n, dtype=float)
        self._found.terminated, self._found.success = wp.zeros(n, dtype=bool), wp.zeros(n, dtype=bool)
        self._found.fault = wp.zeros((parts, n), dtype=int)  # type: ignore[assignment]
        self.obs, self.final_obs = kernels.Observations(), kernels.Observations()
        self._finite_obs = wp.zeros((len(self.obs_spaces), n), dtype=bool)
        self._observing = len(self.obs_spaces) if self.device.is_cuda else 1  # threads that observe a world
        self.obs_groups, self.final_obs_groups = (self._allocate_groups(into) for into in (self.obs, self.final_obs))
        self.buffers |= {"obs": self.obs_groups["policy"], "final_obs": self.final_obs_groups["policy"]}
        naction = self.action_space.size
        self.action, self.safe_action = wp.zeros((n, naction), dtype=float), wp.zeros((n, naction), dtype=float)
        self.buffers["action"] = torch_view(self.action)
        ranges, scale = control_ranges(model), np.zeros((model.nu, 2))
        if self.task.functions["control"] is None:
            scale = control_scale(model, task.action_range)
        self.ranges: wp.array = wp.array(ranges, dtype=float)
        self.scale: wp.array = wp.array(scale, dtype=float)

        self.counters = steps.Counters()
        self.counters.step, self.counters.episode = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
        self.counters.key = wp.zeros(n, dtype=wp.uint32)
        self.counters.rng = wp.zeros((len(self.obs_spaces) * n, 1), dtype=wp.uint32)  # type: ignore[assignment]
        self._seed = wp.zeros(1, dtype=int)
        self._action_fault, self._no_fault, self._judged = (wp.zeros(n, dtype=int) for _ in range(3))
        self.fault_count = wp.zeros((n, int(FAULTS).bit_length()), dtype=int)
        self.everyone, self.mask = wp.full(n, True, dtype=bool), wp.zeros(n, dtype=bool)
        self.restarting, self._drawing = wp.zeros(n, dtype=bool), wp.zeros(n, dtype=bool)
        self._going_on, self._moved, self.changed, self._stale = (wp.zeros(n, dtype=bool) for _ in range(4))
        self.changed_view = torch_view(self.changed)
        """The worlds that the events of the last step changed, (nworld,) bool."""
        self.state = wp.zeros((n, self.state_space.size), dtype=wp.float64)
        self.mask_view, self.state_view = torch_view(self.mask), torch_view(self.state)

    def _allocate_groups(self, into: Any) -> dict[str, torch.Tensor]:
        for group, space in self.obs_spaces.items():
            setattr(into, group, wp.zeros((self.nworld, space.size), dtype=float))
        return {group: torch_view(getattr(into, group)) for group in self.obs_spaces}

    def configure(self, *, horizon: int, autoreset: bool, graphs: bool) -> None:
        """Choose the horizon, whether episodes restart automatically, and whether launches become graphs.

        Graphs hold the first two, so each combination has graphs of its own.
        """
        self.horizon, self.autoreset = horizon, autoreset
        key = (horizon, autoreset, graphs)
        if key not in self._programs:
            capture = Graphs(
                self.device, enabled=graphs, capture_engine=self.engine.capturable, nvtx=self._nvtx,
                workers=self._workers,
            )  # fmt: skip
            self._programs[key] = Programs(
                capture,
                step=capture.sequence(self._phases_of_a_graph() if graphs else self.step_phases()),
                reset=capture.sequence(self.reset_phases(randomly=False)),
                rand_reset=capture.sequence(self.reset_phases(randomly=True)),
                read_state=capture.sequence(self.read_phases()),
                restore_state=capture.sequence(self.restore_phases()),
            )
        self.programs = self._programs[key]
        self.step = self.programs.step

    def _make_workers(self) -> Workers | None:
        """Threads for the launches around the engine's calls, or None where the caller's is the only one."""
        # Warp's kernels for debugging keep the address of a stack in a variable that all threads share
        if not self.device.is_cpu or self.engine.capturable or wp.config.mode == "debug":
            return None
        nthread = self.engine.launch_threads
        return Workers(nthread) if nthread > 1 else None

    # phases

    def step_phases(self) -> list[Phase]:
        """One step, in order."""
        return [
            *self._transition_phases(),
            *self._restart_phases(self.restarting, randomly=True),
            *self._event_phases(),
            *self._moved_phases(),
            *self._refresh_phases(self.restarting),
            *self._observe_phases(),
        ]

    def _phases_of_a_graph(self) -> list[Phase]:
        """The same where a step is one graph: parts of it are left out in a step in which they concern no world."""
        if not self.engine.capturable or self._nvtx:
            return self.step_phases()
        restart = self._restart_phases(self.restarting, randomly=True)
        show = self._refresh_phases(self.restarting), self._observe_phases()
        if not (events := self._event_phases()):
            return [*self._transition_phases(), self._only_for(self.restarting, restart, *show)]
        moved = self._moved_phases()
        return [
            *self._transition_phases(),
            self._only_for(self.restarting, restart),
            *events,
            *([self._only_for(self._moved, moved)] if moved else []),
            *([self._only_for(self.restarting, show[0])] if show[0] else []),
            *show[1],
        ]

    def _only_for(self, mask: wp.array, *phases: list[Phase]) -> Phase:
        """Phases as one that is left out where the mask holds no world."""
        every = [phase for part in phases for phase in part]

        def run() -> None:
            for phase in every:
                phase.run()

        return Phase(every[0].name, partial(self.engine.run_for, mask, run), engine=True)

    def _transition_phases(self) -> list[Phase]:
        """The transition to the next state, and its judgement."""
        return [
            Phase("act", self.act, by_world=True),
            *self.physics_phases(),
            Phase("judge", self._judge_step, by_world=True),
        ]

    def physics_phases(self) -> list[Phase]:
        """The substeps of a step."""
        skip = self.task.frame_skip
        if self.task.kernels.substep_memory is None:
            return self.engine.step_phases(skip)
        substep = [*self.engine.step_phases(1), Phase("substep", self._substep, by_world=True)]
        return substep * skip

    def reset_phases(self, *, randomly: bool) -> list[Phase]:
        """New episodes in the worlds of ``mask``, in order."""
        return [
            *self._restart_phases(self.mask, randomly=randomly),
            *self._refresh_phases(self.mask),
            Phase("judge", self._judge_state, by_world=True),
        ]

    def _restart_phases(self, mask: wp.array, *, randomly: bool) -> list[Phase]:
        """The masked worlds into initial states of the task, whose derived fields are not computed yet."""
        phases = [Phase("restart", partial(self._restart, mask, randomly=randomly), by_world=True)]
        if self.task.reset_dynamics:
            phases.append(Phase("dynamics", partial(self.engine.apply_model, mask), engine=True))
        if randomly and self.task.kernels.reject_worlds is not None:
            phases.append(Phase("redraw", partial(self._redraw, mask), engine=True))
        if settle := self.task.task.settle:
            phases.append(Phase("settle", partial(self.engine.settle, mask, settle), engine=True))
        return phases

    def _event_phases(self) -> list[Phase]:
        """What happens between two steps, in worlds that go on."""
        return [] if self.task.kernels.run_events is None else [Phase("event", self._event)]

    def _moved_phases(self) -> list[Phase]:
        """What follows in the worlds whose physics an event changed."""
        if self.task.kernels.run_events is None:
            return []
        phases = []
        if any(field.name in self.task.writes["event"] for field in self.task.dynamics):
            phases.append(Phase("event dynamics", partial(self.engine.apply_model, self._moved), engine=True))
        if self.engine.stage > Stage.NONE:
            phases.append(Phase("event refresh", partial(self.engine.refresh_current, self._moved), engine=True))
        return phases

    def _observe_phases(self) -> list[Phase]:
        """Observations of the worlds that changed since they were judged."""
        changed = self.restarting if self.task.kernels.run_events is None else self._stale
        return [Phase("observe", partial(self._observe, changed), by_world=True)]

    def _refresh_phases(self, mask: wp.array) -> list[Phase]:
        if self.engine.reset_stage == Stage.NONE:  # no field follows from the state
            return []
        return [Phase("refresh", partial(self.engine.refresh, mask), engine=True)]

    def read_phases(self) -> list[Phase]:
        """Every world's state into ``state``."""
        return [Phase("read state", self._read_state)]

    def restore_phases(self) -> list[Phase]:
        """The worlds of ``mask`` into the states of ``state``, in order; every getter reflects them afterwards."""
        engine_columns = self.state[:, : self.engine.state_size]
        return [
            Phase("restore engine", partial(self.engine.set_state, engine_columns, self.mask), engine=True),
            Phase("restore counters", self._restore_counters),
            Phase("judge", partial(self._judge_state, keep_reason=True), by_world=True),
        ]

    def rehearsal(self) -> None:
        """Run every phase that is made of launches once, in arbitrary order, to find the kernels that they launch."""
        self.seed_streams(0)
        phases = (*self.reset_phases(randomly=True), *self.step_phases(), *self.read_phases(), *self.restore_phases())
        for phase in phases:
            if self.engine.capturable or not phase.engine:
                phase.run()

    def keep_before(self) -> None:
        """Keep the current state as the one that a transition starts from."""
        if (kernel := self.task.kernels.keep_before) is not None:
            launch_lanes(kernel, self.nworld, [self.after, self.before], self.device)

    def act(self) -> None:
        """Keep the state that the step starts from, and turn actions into controls."""
        self.keep_before()
        launch_worlds(self.task.kernels.act, self.nworld, [
            self.after, self.params, self.action, self.ranges, self.scale, self.counters, self.safe_action,
            self._action_fault, self.engine.ctrl,
        ], self.device)  # fmt: skip
        if (check_model := self.task.kernels.check_model) is not None:
            launch_lanes(check_model, self.nworld, [self.after, self._action_fault], self.device)

    def _substep(self) -> None:
        args = [self.after, self.params]
        launch_worlds(self.task.kernels.substep_memory, self.nworld, args, self.device)

    def _judge_step(self) -> None:
        """Find faults, advance task memory, and judge the transition."""
        self.engine.find_faults(self.everyone)
        self.advance_memory()
        keep_reason = not self.autoreset
        self._judge(self.everyone, self.engine.fault, self._action_fault, transition=True, keep_reason=keep_reason)

    def advance_memory(self) -> None:
        """Advance task memory by one step."""
        if (advance := self.task.kernels.advance_memory) is not None:
            args = [self.before, self.after, self.params, self.safe_action, self.counters]
            launch_worlds(advance, self.nworld, args, self.device)

    def _judge(
        self, mask: wp.array, fault: wp.array, action_fault: wp.array, *, transition: bool, keep_reason: bool = False
    ) -> None:
        """Reward, metrics, evaluation, ends and observations of the masked worlds; see ``kernels.steps``."""
        kernels = self.task.kernels
        if kernels.check_memory is not None:
            launch_lanes(kernels.check_memory, self.nworld, [mask, self.before, self.after, fault], self.device)
        launch_parts(kernels.judge, self._judging, self.nworld, [
            mask, self.before, self.after, self.params, self.safe_action, self.counters, transition, fault,
            action_fault, self._found, self.metrics, self.final_obs, self._judging,
        ], self.device)  # fmt: skip
        launch_lanes(kernels.conclude, self.nworld, [
            mask, self.before, self.params, self._found, self.counters.step, self.horizon, transition, keep_reason,
            fault, action_fault, self.outcome, self.metric_sums, self.obs, self.final_obs, self.restarting,
            self.fault_count,
        ], self.device)  # fmt: skip
        self._hold_success(mask, transition=transition)

    def _hold_success(self, mask: wp.array, *, transition: bool) -> None:
        """Ask for several steps in a row with the goal met, where the task does so."""
        if self.success_counts.size:
            args = [mask, transition, self.task.task.success_steps, self.success_counts, self.outcome.success]
            launch_worlds(steps.hold_success, self.nworld, args, self.device)

    def _restart(self, mask: wp.array, *, randomly: bool, again: bool = False) -> None:
        """Put the masked worlds into an initial state of the task."""
        self.engine.reset(mask)
        self._clear(mask, "memory", *self.task.task.cleared, *([] if again else ["metric_sums", "success_counts"]))
        if self.task.kernels.reject_worlds is not None:  # a rejected draw changes nothing else
            kept, live = self._lasting_before, self.lasting_memory
            launch_rows(state.copy_rows, mask, *((kept, live) if again else (live, kept)))
        self._make_nominal(mask, self.task.reset_dynamics)
        args = [mask, randomly, again, self.after, self.params, self.counters]
        launch_worlds(self.task.kernels.restart, self.nworld, args, self.device)
        self.engine.commit(mask)

    def _clear(self, mask: wp.array, *names: str) -> None:
        for name in names:
            if (array := self._clearable[name]).size:
                launch_rows(state.fill_rows, mask, self._zeros[: array.shape[1]], array)

    def _make_nominal(self, mask: wp.array, names: Iterable[str]) -> None:
        """Give model fields of the masked worlds their nominal values."""
        for name in names:
            launch_rows(state.fill_rows, mask, flat(self.engine.nominal[name])[0], flat(self.engine.arrays[name]))

    def _redraw(self, mask: wp.array) -> None:
        """Draw initial states of the masked worlds again while the task rejects them."""
        wp.copy(self._drawing, mask)
        for _ in range(self.task.task.draws - 1):
            # on a device that runs behind, the launches go on with an empty mask instead
            if not self.engine.capturable and not self._drawing.numpy().any():
                return
            self.engine.refresh(self._drawing)
            args = [self._drawing, self.after, self.params, self._drawing]
            launch_worlds(self.task.kernels.reject_worlds, self.nworld, args, self.device)
            self._restart(self._drawing, randomly=True, again=True)
            if self.task.reset_dynamics:
                self.engine.apply_model(self._drawing)

    def _event(self) -> None:
        """Run the events, and find the worlds that they changed: their physics, or anything."""
        written = self.task.writes["event"]
        live = {name: getattr(self.after, name) for name in self._copies if name in written}
        drawn = {name: self.engine.arrays[name] for name in self._model_copies}
        for name, array in (live | drawn).items():
            wp.copy(self._before_event(name), array)
        launch_worlds(self.task.kernels.run_events, self.nworld, [
            self.restarting, self.after, self.params, self.counters, self._going_on, self._moved, self.changed,
            self._stale,
        ], self.device)  # fmt: skip
        for name, array in (live | drawn).items():
            self._mark_changes(self._before_event(name), array, physics=name not in MEMORIES)
        self.engine.commit(self._moved, [name for name in live if name not in MEMORIES])

    def _mark_changes(self, before: wp.array, after: wp.array, *, physics: bool) -> None:
        """Mark the worlds that go on and in which a field changed: it is physics, or the task's memory."""
        args = [self._going_on, flat(before), flat(after), physics, self._moved, self.changed, self._stale]
        launch_lanes(rows.mark_changes, self.nworld, args, self.device)

    def _before_event(self, name: str) -> wp.array:
        """Where the values of a field before an event are kept."""
        return self._model_copies[name] if name in self._model_copies else self._copies[name]

    def _observe(self, mask: wp.array) -> None:
        """Observe the masked worlds; the others were observed when they were judged."""
        kernels, finite, parts = self.task.kernels, self._finite_obs, self._observing
        args = [mask, self.after, self.params, self.counters, self.final_obs, finite, self.obs, parts]
        launch_parts(kernels.observe_worlds, parts, self.nworld, args, self.device)
        if parts > 1:
            args = [mask, finite, self.final_obs, self.obs]
            launch_lanes(kernels.replace_observations, self.nworld, args, self.device)

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
        own = self.counters
        counters = [own.step, own.key, own.episode, ended, self.state[:, size:]]
        wp.launch(state.pack_counters, self.nworld, counters, device=self.device)
        for array, columns in self._own_parts():
            launch_rows(state.widen, self.everyone, array, columns)

    def _restore_counters(self) -> None:
        self.restore_counters(self.mask, self.state[:, self.engine.state_size :])
        for array, columns in self._own_parts():
            launch_rows(state.narrow, self.mask, columns, array)

    def _own_parts(self) -> Iterator[tuple[wp.array, wp.array]]:
        """Arrays that belong to the state beside the engine's and the counters, with their columns."""
        arrays = {name: getattr(self, name) for name in MEMORIES}
        arrays |= {"metrics": self.metric_sums, "success_steps": self.success_counts}
        for name in own_parts(self.task):
            yield arrays[name], self.state[:, self.state_space.parts[name]]

    # parts of phases, and preparations, for environments and open-loop rollouts

    def restore_counters(self, mask: wp.array, columns: wp.array) -> None:
        """Set the masked worlds' counters from columns of states."""
        own = self.counters
        counters = [mask, columns, own.step, own.key, own.episode, self.outcome.done_reason]
        wp.launch(state.unpack_counters, self.nworld, counters, device=self.device)

    def judge_transition(self, action: torch.Tensor) -> None:
        """Judge the transition from ``before`` to the current state under some actions, without looking for faults."""
        torch_view(self.safe_action).copy_(action)
        self._judged.zero_()  # gets the faults of this transition
        self._judge(self.everyone, self._judged, self._no_fault, transition=True)

    def seed_streams(self, seed: int) -> None:
        """Restart the random streams of the masked worlds, and draw what is drawn once for each stream."""
        self._seed.fill_(seed)
        args = [self.mask, self._seed, self.first_world, self.counters.key, self.counters.episode]
        wp.launch(random.seed_worlds, self.nworld, args, device=self.device)
        self._clear(self.mask, "lasting_memory")
        self._make_nominal(self.mask, [field.name for field in self.task.dynamics])
        if self.task.kernels.start_worlds is not None:
            args = [self.mask, self.after, self.params, self.counters]
            launch_worlds(self.task.kernels.start_worlds, self.nworld, args, self.device)
        if self.task.dynamics:
            self.engine.apply_model(self.mask)

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
