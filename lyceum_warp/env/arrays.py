"""Allocate the arrays of an environment's worlds, and convert them to and from state vectors."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.parts import sizes
from lyceum_warp.core import spaces
from lyceum_warp.core.done import FAULTS
from lyceum_warp.core.task import MEMORIES
from lyceum_warp.engines.base import Engine
from lyceum_warp.kernels import state, step_types, transitions
from lyceum_warp.support.arrays import flat, launch_rows, shared_rows, torch_view, with_memory, words, zeros_of
from lyceum_warp.support.tensors import check_tensor


def own_bytes_per_world(task: BoundTask, engine: str) -> int:
    """Estimate the bytes that each world needs outside the arrays of the engine with the given name."""
    parts, snapshots = own_parts(task), [field for field in task.fields if field.snapshot]
    state_size = spaces.state_space(task.model, snapshots, task.dynamics, parts).size
    copies = sum(field.size for field in task.fields)
    observations = sum(sum(layout.values()) for layout in task.layouts.obs.values())
    total = 4 * copies + 8 * state_size + 8 * observations + 300
    if task.cameras:
        from lyceum_warp.engines.pictures import picture_bytes  # loads MuJoCo Warp

        total += picture_bytes(task.model, task.cameras, engine)
    return total


def own_parts(task: BoundTask) -> dict[str, int]:
    """Compute the sizes of the parts that ``Worlds`` adds to the engine's state, except for the counters."""
    form, parts = task.definition, dict[str, int]()
    for layout in task.layouts.memory.values():
        parts |= sizes(layout)
    counts = {"metrics": len(task.metrics), "success_steps": int(form.success_steps > 1)}
    return parts | {name: size for name, size in counts.items() if size}


def memory_columns(task: BoundTask, space: spaces.Space) -> dict[str, slice]:
    """Get the columns of ``memory`` and ``lasting_memory`` in a state."""
    ends = {name: [space.parts[part] for part in layout] for name, layout in task.layouts.memory.items() if layout}
    return {name: slice(parts[0].start, parts[-1].stop) for name, parts in ends.items()}


class WorldArrays:
    """All arrays of an environment's worlds."""

    def __init__(self, task: BoundTask, engine: Engine, *, final_pictures: bool = False) -> None:
        self.task, self.engine = task, engine
        self.device, self.nworld = engine.device, engine.nworld
        with wp.ScopedDevice(self.device):
            self._allocate_fields()
            self._allocate_outcome()
            self._allocate_actions()
            self._allocate_counters()
            self._allocate_masks()
            self.state = wp.zeros((self.nworld, self.state_space.size), dtype=wp.float64)
        self.state_view = torch_view(self.state)
        index = [float(index) for index in task.objects.values()]
        self.object_index: wp.array = wp.array(index, dtype=float, device=self.device)
        """The indices of the objects that worlds hold."""
        self.drawn: dict[str, wp.array] = {}
        """Each world's own values of fitted model fields, (nworld, size), which take the place of the nominal ones."""
        self._allocate_pictures(final_pictures)

    def _allocate_pictures(self, final: bool) -> None:
        self.pictures, self._final_pictures = None, list[tuple[Any, Any]]()
        self.picture_groups, self.final_picture_groups = {}, {}
        self.picture_spaces = {camera.group: spaces.picture_space(camera) for camera in self.task.cameras}
        if not self.task.cameras:
            return
        from lyceum_warp.engines.pictures import Pictures  # loads MuJoCo Warp

        self.pictures = Pictures(self.engine, self.task.cameras)
        self.picture_groups = self.pictures.groups
        if final:
            self.final_picture_groups = {group: torch.zeros_like(now) for group, now in self.picture_groups.items()}
            pairs = zip(self.picture_groups.values(), self.final_picture_groups.values(), strict=True)
            self._final_pictures += [(wp.from_torch(words(live)), wp.from_torch(words(last))) for live, last in pairs]

    def _allocate_fields(self) -> None:
        n, model, task = self.nworld, self.task.model, self.task.definition
        self.memory, self.lasting_memory, self._lasting_before = (
            wp.zeros((n, sum(sizes(self.task.layouts.memory[name]).values())), dtype=float)
            for name in ("memory", "lasting_memory", "lasting_memory")
        )
        counts = {"success_count": (n, int(task.success_steps > 1)), "metric_sum": (n, len(self.task.metrics))}
        self.episodes = zeros_of(step_types.Episodes, n, fault_count=(n, int(FAULTS).bit_length()), **counts)
        self.episodes.success_steps = task.success_steps
        self._clearable = {
            "memory": self.memory, "lasting_memory": self.lasting_memory, "metrics": self.episodes.metric_sum,
            "success_steps": self.episodes.success_count,
            **{name: flat(self.engine.arrays[name]) for name in task.cleared},
        }  # fmt: skip
        self._zeros = wp.zeros(max(array.shape[1] for array in self._clearable.values()), dtype=float)
        self.transition = self.task.kernels.Transition()
        """The arrays of the last step, which the kernels of the task use."""
        self.after, self.before = self.transition.after, self.transition.before
        self._copies: dict[str, wp.array] = {}
        constant = {f.name: shared_rows(f.value(model), f.dtype, n, self.device) for f in self.task.constants}
        varied = [field.name for field in self.task.dynamics]
        for name in self.task.types:
            live: Any = getattr(self, name) if name in MEMORIES else constant.get(name, self.engine.arrays.get(name))
            self.task.check_field(name, live)
            live = with_memory(live)
            setattr(self.after, name, live)
            if live.size and name not in constant and name not in varied:  # steps do not change the model
                self._copies[name] = wp.zeros_like(live)
            setattr(self.before, name, self._copies.get(name, live))
        self._allocate_shared()
        self.fields = {**self.engine.arrays, **constant}
        """Arrays of all fields, (nworld, ...), by name."""
        drawn = [f.name for f in self.task.dynamics if f.name in self.task.writes["event"]]
        self._model_copies = {name: wp.zeros_like(self.engine.arrays[name]) for name in drawn}
        self.params = self.task.parameters.array(self.device)
        self.weights = self.task.parameters.weights(self.device)
        self.transition.params, self.transition.weights = self.params, self.weights
        self.action_space = spaces.action_space(model, task.action_range, self.task.layouts.actions)
        self.obs_spaces = {group: spaces.Space.of(layout) for group, layout in self.task.layouts.obs.items()}
        self.state_space = spaces.state_space(model, self.engine.snapshots, self.task.dynamics, own_parts(self.task))

    def _allocate_shared(self) -> None:
        layouts = self.task.layouts.shared
        shared, sums = (sum(sizes(layouts.get(name, {})).values()) for name in ("Shared", "Sums"))
        self.shared, self.sums = wp.zeros((1, shared), dtype=float), wp.zeros(sums, dtype=wp.int64)
        """``shared`` has shape (1, size of Shared). ``sums`` has shape (size of Sums,). It stores 1.0 as ``UNIT``."""
        self._shares = wp.zeros((self.nworld, sums), dtype=float)
        if layouts:
            for batch in (self.after, self.before):
                batch.shared = self.shared

    def _allocate_outcome(self) -> None:
        n, metrics = self.nworld, (self.nworld, len(self.task.metrics))
        self.outcome = zeros_of(step_types.Outcome, n, metrics=metrics, episode_metrics=metrics)
        self.buffers = {name: torch_view(getattr(self.outcome, name)) for name in step_types.OUTCOMES}
        self.metrics, self.episode_metrics = self.outcome.metrics, self.outcome.episode_metrics
        self.judged_parts = parts = int(transitions.OBSERVE_FIRST) + len(self.obs_spaces)
        """Number of parts of the kernel ``judge``."""
        self._judging = parts if self.device.is_cuda else 1  # threads per transition
        self._findings = zeros_of(step_types.Findings, n, fault=(parts, n))
        shapes = {group: (n, space.size) for group, space in self.obs_spaces.items()}
        self.obs, self.final_obs = (zeros_of(self.task.kernels.Observations, **shapes) for _ in range(2))
        self._finite_obs = wp.zeros((len(self.obs_spaces), n), dtype=bool)
        # threads per observation
        self._observing = len(self.obs_spaces) if self.device.is_cuda else 1
        self.obs_groups, self.final_obs_groups = (
            {group: torch_view(getattr(observations, group)) for group in shapes}
            for observations in (self.obs, self.final_obs)
        )
        self.buffers |= {"obs": self.obs_groups["policy"], "final_obs": self.final_obs_groups["policy"]}

    def _allocate_actions(self) -> None:
        n, model, task = self.nworld, self.task.model, self.task.definition
        naction = self.action_space.size
        self.action, self.safe_action = wp.zeros((n, naction), dtype=float), wp.zeros((n, naction), dtype=float)
        self.transition.action = self.safe_action
        self.buffers["action"] = torch_view(self.action)
        ranges, scale = spaces.control_ranges(model), np.zeros((model.nu, 2))
        if self.task.functions["control"] is None:
            scale = spaces.control_scale(model, task.action_range)
        self.ranges: wp.array = wp.array(ranges, dtype=float)
        self.scale: wp.array = wp.array(scale, dtype=float)

    def _allocate_counters(self) -> None:
        n = self.nworld
        self.counters = zeros_of(step_types.Counters, n, rng=(len(self.obs_spaces) * n, 1))
        self.transition.counters = self.counters
        self._seed = wp.zeros(1, dtype=int)
        self._action_fault, self._no_fault, self._judged = (wp.zeros(n, dtype=int) for _ in range(3))

    def _allocate_masks(self) -> None:
        n = self.nworld
        self.everyone = wp.full(n, True, dtype=bool)
        self.mask = wp.zeros(n, dtype=bool)
        """Worlds that the next reset or restore changes."""
        self.restarting = self.episodes.restart
        """Worlds whose episode ended in the last step."""
        self._rejected = wp.zeros(n, dtype=bool)
        self._physics_changed = wp.zeros(n, dtype=bool)
        """Worlds whose physics an event changed."""
        self._changed = wp.zeros(n, dtype=bool)
        """Worlds whose physics or memory an event changed."""
        self._outdated = wp.zeros(n, dtype=bool)
        """Worlds that need a new observation after a restart or an event."""
        self.mask_view, self.changed_view = torch_view(self.mask), torch_view(self._changed)
        self.terminated_view = torch_view(self._findings.terminated)

    def set_mask(self, mask: torch.Tensor | None) -> None:
        """Choose the worlds that the next reset or restore changes; None means all."""
        if mask is None:
            self.mask_view.fill_(True)
        else:
            check_tensor(mask, "a mask", self.mask_view)
            self.mask_view.copy_(mask)

    def pack_state(self, ended: wp.array) -> None:
        """Write the state of every world into ``state``. Its part ``done_reason`` is taken from ``ended``."""
        size = self.engine.state_size
        self.engine.get_state(self.state[:, :size])
        counters = [self.counters, ended, self.state[:, size:]]
        wp.launch(state.pack_counters, self.nworld, counters, device=self.device)
        for array, columns in self._own_parts():
            launch_rows(state.widen, self.everyone, array, columns)

    def unpack_state(self) -> None:
        """Set counters, memory and sums of the selected worlds from ``state``."""
        self.restore_counters(self.mask, self.state[:, self.engine.state_size :])
        for array, columns in self._own_parts():
            launch_rows(state.narrow, self.mask, columns, array)

    def _own_parts(self) -> Iterator[tuple[wp.array, wp.array]]:
        columns = memory_columns(self.task, self.state_space)
        columns |= {name: self.state_space.parts[name] for name in own_parts(self.task) if name in spaces.OWN_PARTS}
        for name, place in columns.items():
            yield self._clearable[name], self.state[:, place]

    def restore_counters(self, mask: wp.array, columns: wp.array) -> None:
        """Set the selected worlds' counters from ``columns``, the state's columns after those of the engine."""
        counters = [mask, columns, self.counters, self.outcome.done_reason]
        wp.launch(state.unpack_counters, self.nworld, counters, device=self.device)
