"""Run the phases of a step, of a reset, and of reading and restoring states."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.core.fields import Stage, elements
from lyceum_warp.core.options import EnvOptions
from lyceum_warp.core.task import MEMORIES, Task
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.placement import engine_name, find_device, open_engine
from lyceum_warp.env.arrays import own_bytes_per_world
from lyceum_warp.env.resets import Resets
from lyceum_warp.graphs.capture import Calls, Graphs, Phase
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.kernels import rows, state
from lyceum_warp.support.arrays import (
    flat,
    launch_lanes,
    launch_parts,
    launch_rows,
    launch_worlds,
    torch_view,
)


@dataclasses.dataclass(frozen=True)
class Programs:
    """The callables of an environment's phases. Each combination of horizon, autoreset and graphs has its own."""

    graphs: Graphs
    step: Calls
    reset: Calls
    rand_reset: Calls
    read_state: Calls
    restore_state: Calls


def open_worlds(task: type[Task], options: EnvOptions, params: Mapping[str, Any]) -> "Worlds":
    """Bind a task to its model and parameters, open its engine, and allocate the arrays of its worlds."""
    bound = BoundTask(
        task, options.nworld, model=options.model, fields=options.fields, dynamics=options.dynamics,
        physics=options.physics, params=params, fitted=options.fitted, fitted_draws=options.fitted_draws,
        cameras=options.cameras, objects=options.objects,
    )  # fmt: skip
    reserved = own_bytes_per_world(bound, engine_name(options.engine, options.device))
    engine = open_engine(
        options.engine, bound.model, options.nworld, find_device(options.device), bound.fields,
        dynamics=bound.dynamics, initial=bound.initial, reserved=reserved, **options.for_engine(),
    )  # fmt: skip
    return Worlds(bound, engine, options)


class Worlds(Resets):
    """Many worlds of one task on one engine, with the phases that update their arrays.

    A captured graph repeats launches, so a phase must always launch the same kernels on the same arrays.
    """

    def __init__(self, task: BoundTask, engine: Engine, options: EnvOptions) -> None:
        super().__init__(task, engine, final_pictures=options.final_pictures)
        if task.fit is not None and options.fitted_draws:
            draws = task.fit.draws(task.model, self.nworld, options.seed, options.first_world)
            self.drawn = {name: wp.array(rows, dtype=float, device=self.device) for name, rows in draws.items()}
        # Warp's kernels in debug mode are not thread-safe
        parallel = self.device.is_cpu and not engine.capturable and wp.config.mode != "debug"
        self._workers = Workers(engine.launch_threads) if parallel and engine.launch_threads > 1 else None
        self._programs: dict[tuple[int, bool, bool], Programs] = {}
        horizon = task.definition.horizon if options.horizon is None else options.horizon
        self.configure(horizon=horizon, autoreset=options.autoreset, graphs=options.graphs)

    def configure(self, *, horizon: int, autoreset: bool, graphs: bool) -> None:
        """Set the horizon, automatic restarts, and whether to capture launches as graphs."""
        self.horizon, self.autoreset, self.episodes.horizon = horizon, autoreset, horizon
        key = (horizon, autoreset, graphs)
        if key not in self._programs:
            reset, rand_reset = self.reset_phases(randomly=False), self.reset_phases(randomly=True)
            read, restore = self.read_phases(), self.restore_phases()
            step = self.step_phases(skip=graphs and self.engine.capturable)
            capture = Graphs(self.device, enabled=graphs, capture_engine=self.engine.capturable, workers=self._workers)
            self._programs[key] = Programs(
                capture,
                step=capture.sequence(step),
                reset=capture.sequence(reset),
                rand_reset=capture.sequence(rand_reset),
                read_state=capture.sequence(read),
                restore_state=capture.sequence(restore),
            )
        self.programs = self._programs[key]

    def drop_programs(self) -> None:
        """Delete the programs, whose reference cycles would keep threads and memory alive."""
        self._programs.clear()
        del self.programs

    # phases

    def step_phases(self, substeps: int | None = None, *, skip: bool = False) -> list[Phase]:
        """List the phases of a step in order.

        With ``skip``, the phases of restarts and events are merged, so that a graph skips them if no world needs them.
        """

        def only(mask: wp.array, *parts: list[Phase]) -> list[Phase]:
            phases = [phase for part in parts for phase in part]
            return [self._merged(mask, phases)] if skip and phases else phases

        restarting, events = self.restarting, list[Phase]()
        if (kernel := self.task.kernels.run_events) is not None:
            moved = only(self._physics_changed, self._moved_phases())
            events = [Phase("event", partial(self._event, kernel)), *moved]
        outdated = self._outdated if events else restarting
        restart = self.restart_phases(restarting, randomly=True)
        observe = [Phase("observe", partial(self._observe, outdated), by_world=True)]
        if events and not self.engine.refreshes_all:
            episodes = [*only(restarting, restart, self.refresh_phases(restarting)), *observe]
        else:
            episodes = only(outdated, restart, self.refresh_phases(outdated), observe)
        final = [Phase("final pictures", self._keep_final_pictures)] if self._final_pictures else []
        ends = [*self.transition_phases(substeps, rendered=self.pictures is not None), *only(restarting, final)]
        return [*ends, *events, *episodes, *self.picture_phases()]

    def picture_phases(self) -> list[Phase]:
        """List the phase that renders the pictures of all worlds, if there are cameras."""
        return [] if self.pictures is None else [Phase("pictures", self.pictures.render)]

    def _keep_final_pictures(self) -> None:
        """Render the worlds whose episode ended, before they restart. The renderer has no mask of worlds."""
        assert self.pictures is not None
        self.pictures.render()
        for live, final in self._final_pictures:
            launch_rows(state.copy_rows, self.restarting, live, final)

    def _merged(self, mask: wp.array, phases: list[Phase]) -> Phase:
        """Merge phases into one that is skipped if the mask is empty."""

        def run() -> None:
            for phase in phases:
                phase.run()

        return Phase(phases[0].name, partial(self.engine.run_for, mask, run), engine=True)

    def transition_phases(self, substeps: int | None = None, *, rendered: bool = False) -> list[Phase]:
        """List the phases of a step that advance and evaluate the worlds, without resets and events.

        ``rendered`` tells that pictures of the states before the step have been rendered.
        """
        phases = [
            Phase("act", self.act, by_world=True),
            *self.physics_phases(substeps, rendered=rendered),
            Phase("judge", self._judge_step, by_world=True),
        ]
        if self.autoreset and (kernel := self.task.kernels.tally_worlds) is not None:
            phases.append(Phase("tally", partial(self._tally, kernel)))  # on a CPU, atomic additions need one thread
        return phases

    def physics_phases(self, substeps: int | None = None, *, rendered: bool = False) -> list[Phase]:
        """List the phases of a step's substeps."""
        engine, skip = self.engine, self.task.frame_skip if substeps is None else substeps
        if (kernel := self.task.kernels.substep_memory) is None:
            return engine.step_phases(skip, rendered=rendered)
        between = Phase("substep", partial(self._substep, kernel), by_world=True)
        whole = any(engine.fields[name].refresh for name in self.task.source.read_in_substeps & engine.fields.keys())
        parts = [
            engine.step_phases(1, first=whole or i == 0, last=whole or i == skip - 1, rendered=rendered and i == 0)
            for i in range(skip)
        ]
        return [phase for part in parts for phase in (*part, between)]

    def reset_phases(self, *, randomly: bool) -> list[Phase]:
        """List the phases that start episodes in the worlds of ``mask``."""
        return [
            *self.restart_phases(self.mask, randomly=randomly),
            *self.refresh_phases(self.mask),
            Phase("judge", self._judge_state, by_world=True),
            *self.picture_phases(),
        ]

    def _moved_phases(self) -> list[Phase]:
        phases, changed = [], self._physics_changed
        if any(field.name in self.task.writes["event"] for field in self.task.dynamics):
            phases.append(Phase("event dynamics", partial(self.engine.apply_model, changed), engine=True))
        if self.engine.stage > Stage.NONE and not self.engine.refreshes_all:
            phases.append(Phase("event refresh", partial(self.engine.refresh_current, changed), engine=True))
        return phases

    def read_phases(self) -> list[Phase]:
        """List the phases that write all states into ``state``."""
        # with automatic resets, done_reason describes only the last step
        ended = self._no_fault if self.autoreset else self.outcome.done_reason
        return [Phase("read state", partial(self.pack_state, ended))]

    def restore_phases(self) -> list[Phase]:
        """List the phases that restore the selected worlds from ``state``."""
        engine_columns = self.state[:, : self.engine.state_size]
        return [
            Phase("restore engine", partial(self.engine.set_state, engine_columns, self.mask), engine=True),
            Phase("restore counters", self.unpack_state),
            Phase("judge", partial(self._judge_state, keep_reason=True), by_world=True),
            *self.picture_phases(),
        ]

    def rehearsal(self) -> None:
        """Launch the kernels of all phases once, so that ``compile_ahead`` can list them."""
        self.seed_streams(0)
        # two substeps launch all kernels; on the Warp engine, each further substep would take milliseconds
        step = self.step_phases(min(self.task.frame_skip, 2))
        phases = (*self.reset_phases(randomly=True), *step, *self.read_phases(), *self.restore_phases())
        for phase in phases:
            if self.engine.capturable or not phase.engine:
                phase.run()

    def hold_first_controls(self) -> None:
        """Let delayed actuators begin each episode as if the action had been 0 before it.

        Otherwise, their controls would be 0 until the first action arrives, which throws a walking robot upwards.
        """
        assert self.task.fit is not None
        self.set_mask(None)
        self.seed_streams(0)
        self.lasting_memory.zero_()
        self._restart(self.everyone, randomly=False)
        self.act()
        model, state, controls = self.task.model, self.engine.initial.copy(), self.engine.ctrl.numpy()[0]
        data, kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION.value
        mujoco.mj_setState(model, data, state, kind)
        for name in self.task.fit.delays:
            number, held = model.actuator(name).id, controls[elements(model, "ctrl", name)]
            rows = np.tile(held.astype(float), (model.actuator_history[number, 0], 1))
            mujoco.mj_initCtrlHistory(model, data, number, None, rows)
        mujoco.mj_getState(model, data, state, kind)
        self.engine.start_at(state)

    def keep_before(self) -> None:
        """Copy the current state into ``before``."""
        if (kernel := self.task.kernels.keep_before) is not None:
            launch_lanes(kernel, self.nworld, [self.after, self.before], self.device)

    def act(self) -> None:
        """Copy the state before the step, and convert actions to controls."""
        self.keep_before()
        args = [self.transition, self.action, self.ranges, self.scale, self._action_fault, self.engine.ctrl]
        launch_worlds(self.task.kernels.act, self.nworld, args, self.device)
        if (check_model := self.task.kernels.check_model) is not None:
            launch_lanes(check_model, self.nworld, [self.after, self._action_fault], self.device)

    def _substep(self, kernel: wp.Kernel) -> None:
        launch_worlds(kernel, self.nworld, [self.after, self.params], self.device)

    def _judge_step(self) -> None:
        self.engine.find_faults(self.everyone)
        self.advance_memory()
        keep_reason = not self.autoreset
        self._judge(self.everyone, self.engine.fault, self._action_fault, transition=True, keep_reason=keep_reason)

    def advance_memory(self) -> None:
        """Advance the task's memory by a step."""
        if (advance := self.task.kernels.advance_memory) is not None:
            launch_worlds(advance, self.nworld, [self.transition], self.device)

    def _judge(
        self, mask: wp.array, fault: wp.array, action_fault: wp.array, *, transition: bool, keep_reason: bool = False
    ) -> None:
        kernels = self.task.kernels
        if kernels.check_memory is not None:
            launch_lanes(kernels.check_memory, self.nworld, [mask, self.transition, fault], self.device)
        args = [mask, self.transition, transition, fault, action_fault, self._findings, self.metrics, self.final_obs]
        launch_parts(kernels.judge, self._judging, self.nworld, [*args, self._judging], self.device)
        launch_lanes(kernels.conclude, self.nworld, [
            mask, self.transition, self._findings, self.outcome, self.episodes, transition, keep_reason, fault,
            action_fault, self.obs, self.final_obs,
        ], self.device)  # fmt: skip

    def _event(self, kernel: wp.Kernel) -> None:
        before = {name: copy for name, copy in self._copies.items() if name in self.task.writes["event"]}
        before |= self._model_copies
        for name, copy in before.items():
            wp.copy(copy, getattr(self.after, name))
        launch_worlds(kernel, self.nworld, [
            self.restarting, self.transition, self._physics_changed, self._changed, self._outdated,
        ], self.device)  # fmt: skip
        for name, copy in before.items():
            self._mark_changes(copy, getattr(self.after, name), physics=name not in MEMORIES)
        state_fields = [name for name in before if name not in MEMORIES and name not in self._model_copies]
        self.engine.commit(self._physics_changed, state_fields)

    def _mark_changes(self, before: wp.array, after: wp.array, *, physics: bool) -> None:
        """Mark worlds in which an event changed a given field. ``physics`` is False for a memory field."""
        marks = [self._physics_changed, self._changed, self._outdated]
        args = [self.restarting, flat(before), flat(after), physics, *marks]
        launch_lanes(rows.mark_changes, self.nworld, args, self.device)

    def _observe(self, mask: wp.array) -> None:
        """Write new observations of the masked worlds after a restart or an event."""
        kernels, finite, parts = self.task.kernels, self._finite_obs, self._observing
        args = [mask, self.transition, self.final_obs, finite, self.obs, parts]
        launch_parts(kernels.observe_worlds, parts, self.nworld, args, self.device)
        if parts > 1:
            args = [mask, finite, self.final_obs, self.obs]
            launch_lanes(kernels.replace_observations, self.nworld, args, self.device)

    def _tally(self, kernel: wp.Kernel) -> None:
        args = [self.transition, self.outcome.done_reason, self._shares]
        launch_worlds(kernel, self.nworld, args, self.device)
        launch_lanes(self.task.kernels.add_tallies, self.nworld, [self._shares, self.sums], self.device)

    def _judge_state(self, *, keep_reason: bool = False) -> None:
        # a state that was set without a check may be invalid; its world then keeps the last valid observation
        self.engine.find_faults(self.mask)
        keep_reason = keep_reason and not self.autoreset
        self._judge(self.mask, self.engine.fault, self._no_fault, transition=False, keep_reason=keep_reason)

    # called by Env and OpenLoop

    def judge_transition(self, action: torch.Tensor) -> None:
        """Evaluate the transition from ``before`` to the current state, ignoring engine faults."""
        torch_view(self.safe_action).copy_(action)
        self._judged.zero_()
        self._judge(self.everyone, self._judged, self._no_fault, transition=True)

    def update_shared(self) -> None:
        """Update the shared memory from the sums, clear the sums, and observe all worlds again."""
        if (kernel := self.task.kernels.share_memory) is not None:
            launch_worlds(kernel, 1, [self.sums, self._shares, self.params, self.shared], self.device)
            self._observe(self.everyone)

    def update_params(self) -> None:
        """Copy the task's parameters and weights into the kernels' arrays."""
        parameters = self.task.parameters
        changed = {"params": parameters.array(self.device), "weights": parameters.weights(self.device)}
        for name, array in changed.items():
            if array.shape == getattr(self, name).shape:
                wp.copy(getattr(self, name), array)
                continue
            setattr(self, name, array)
            setattr(self.transition, name, array)
            for programs in self._programs.values():
                programs.graphs.forget()
