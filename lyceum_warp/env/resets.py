"""Begin episodes: reset the engine, randomize the state and model fields, and let the worlds settle."""

from collections.abc import Iterable
from functools import partial

import torch
import warp as wp

from lyceum_warp.core.fields import Stage
from lyceum_warp.env.arrays import WorldArrays
from lyceum_warp.graphs.capture import Phase
from lyceum_warp.kernels import random, resets, state
from lyceum_warp.support.arrays import flat, launch_lanes, launch_rows, launch_worlds, repeated, torch_view


class Resets(WorldArrays):
    """The phases of a reset, and the start of random streams."""

    def restart_phases(self, mask: wp.array, *, randomly: bool) -> list[Phase]:
        """List the phases that put the selected worlds into an initial state."""
        phases = [Phase("restart", partial(self._restart, mask, randomly=randomly), by_world=True)]
        if self.task.reset_dynamics:
            phases.append(Phase("dynamics", partial(self.engine.apply_model, mask), engine=True))
        if randomly and (kernel := self.task.kernels.reject_worlds) is not None:
            phases.append(Phase("redraw", partial(self._redraw, kernel, mask), engine=True))
        if settle := self.task.definition.settle:
            phases.append(Phase("settle", partial(self.engine.settle, mask, settle), engine=True))
        return phases

    def refresh_phases(self, mask: wp.array) -> list[Phase]:
        """List the phase that computes derived fields of the selected worlds, if there is one."""
        if self.engine.reset_stage == Stage.NONE:
            return []
        return [Phase("refresh", partial(self.engine.refresh, mask), engine=True)]

    def seed_streams(self, seed: int, first_world: int = 0) -> None:
        """Restart the random streams of the selected worlds, and call the task's ``startup``."""
        self._seed.fill_(seed)
        args = [self.mask, self._seed, first_world, self.counters.key, self.counters.episode]
        wp.launch(random.seed_worlds, self.nworld, args, device=self.device)
        self._clear(self.mask, "lasting_memory")
        if self.task.objects:
            args = [self.mask, self.object_index, first_world % len(self.task.objects), self.engine.arrays["object"]]
            wp.launch(resets.assign_objects, self.nworld, args, device=self.device)
        self._make_nominal(self.mask, [field.name for field in self.task.dynamics])
        if self.task.kernels.start_worlds is not None:
            launch_worlds(self.task.kernels.start_worlds, self.nworld, [self.mask, self.transition], self.device)
        if self.task.dynamics:
            self.engine.apply_model(self.mask)

    def _restart(self, mask: wp.array, *, randomly: bool, again: bool = False) -> None:
        self.engine.reset(mask)
        counts = [] if again else ["metrics", "success_steps"]
        self._clear(mask, "memory", *self.task.definition.cleared, *counts)
        if self.task.kernels.reject_worlds is not None:  # a rejected draw must not change lasting memory
            backup, live = self._lasting_before, self.lasting_memory
            launch_rows(state.copy_rows, mask, *((backup, live) if again else (live, backup)))
        if self.task.redraws and not again:
            args = [mask, self.object_index, randomly, self.counters, self.engine.arrays["object"]]
            launch_worlds(resets.choose_objects, self.nworld, args, self.device)
        self._make_nominal(mask, self.task.reset_dynamics)
        args = [mask, randomly, again, self.transition]
        launch_worlds(self.task.kernels.restart, self.nworld, args, self.device)
        self.engine.commit(mask)

    def _redraw(self, kernel: wp.Kernel, mask: wp.array) -> None:
        wp.copy(self._rejected, mask)
        for _ in range(self.task.definition.draws - 1):
            # on a GPU, reading the mask would wait for the device
            if not self.engine.capturable and not self._rejected.numpy().any():
                return
            self.engine.refresh(self._rejected)
            args = [self._rejected, self.after, self.params, self._rejected]
            launch_worlds(kernel, self.nworld, args, self.device)
            self._restart(self._rejected, randomly=True, again=True)
            if self.task.reset_dynamics:
                self.engine.apply_model(self._rejected)

    def _clear(self, mask: wp.array, *names: str) -> None:
        for name in names:
            if (array := self._clearable[name]).size:
                launch_rows(state.copy_rows, mask, repeated(self._zeros[: array.shape[1]], self.nworld), array)

    def _make_nominal(self, mask: wp.array, names: Iterable[str]) -> None:
        for name in names:
            target, nominal = flat(self.engine.arrays[name]), flat(self.engine.nominal[name])
            if len(nominal) > 1:
                args = [mask, self.engine.arrays["object"], nominal, target]
                launch_lanes(resets.take_nominal, self.nworld, args, self.device)
                continue
            if (rows := self.drawn.get(name)) is None:
                rows = repeated(nominal[0], self.nworld)
            launch_rows(state.copy_rows, mask, rows, target)

    def nominal_rows(self, name: str, objects: torch.Tensor | None = None) -> torch.Tensor:
        """Return the nominal values of a model field for worlds with the given objects, (n, size).

        ``objects`` has the objects' indices, (n,); by default those of the worlds.
        """
        nominal = torch_view(flat(self.engine.nominal[name]))
        if len(nominal) == 1:
            return nominal.expand(self.nworld if objects is None else len(objects), -1)
        held = torch_view(self.engine.arrays["object"])[:, 0] if objects is None else objects
        return nominal[held.long()]
