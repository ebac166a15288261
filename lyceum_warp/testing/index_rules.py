"""Check that no function of a task uses an index out of range, and that results are finite."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.binding import written_fields
from lyceum_warp.core import FAULTS, FUNCTIONS, MEMORIES, Done, observer_name
from lyceum_warp.env import Worlds
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.testing.checked_functions import CheckedFunctions, Unchecked, checked_functions
from lyceum_warp.testing.context import Context

_RESET = ("startup", "initialize", "randomize")

_FEW = 20
"""Number of steps on a slow engine: MuJoCo Warp on a CPU."""


def check_bounds(ctx: Context) -> None:
    """No function of the task reads or writes out of range in a row, a vector or a matrix, and all results are finite.

    Warp counts negative indices from the end, but only constants such as ``-1`` are allowed. A result may be infinite
    or NaN in a state with a fault.
    """
    run = _Run(ctx)
    with ctx.changed(ctx.a, autoreset=False):
        run.steps()
    if problems := [*run.checked.problems(run.report), *run.not_finite]:
        ctx.fail("; ".join(problems))


class _Run:
    def __init__(self, ctx: Context) -> None:
        self.ctx, self.env, self.worlds = ctx, ctx.a, ctx.a.worlds
        task = self.env.task
        self.functions = {name: function for name, function in task.functions.items() if function is not None}
        self.functions |= {name: function for name, function in task.kernels.terms.items() if name != "reward"}
        self.functions |= {observer_name(group): function for group, function in task.observers.items()}
        try:
            self.checked: CheckedFunctions = checked_functions(
                task.source.kernel_name, self.functions, task.kernels.views, self.env.device
            )
        except Unchecked as error:
            ctx.fail(f"the functions could not be checked: {error}")
        self.report = self.checked.report(self.env.device)
        self.keep: list[wp.array] = []
        self.before, self.after, self.start = (self._batch() for _ in range(3))
        self.rng = np.random.default_rng(ctx.seed)
        n, nact, nmetrics = self.env.nworld, self.worlds.action_space.size, len(task.metrics)
        sizes = {"action": nact, "ctrl": task.model.nu, "metrics": nmetrics}
        self.rows = {name: self._array((n, size), wp.float32) for name, size in sizes.items()}
        self.obs = {
            observer_name(group): self._array((n, space.size), wp.float32)
            for group, space in self.worlds.obs_spaces.items()
        }
        self.rows["rng"] = self._array((n, 1), wp.uint32)
        self.rows["sums"] = self._array((n, self.worlds.sums.size), wp.float32)
        self.rows["shared"] = self._array((n, self.worlds.shared.shape[1]), wp.float32)
        self.rows["ended"] = wp.full(1, True, dtype=bool, device=self.env.device)
        self.rows["terminated"] = wp.array([True, False], dtype=bool, device=self.env.device)
        self.not_finite: dict[str, None] = {}
        """Problems: the functions whose results are NaN or infinite in valid states."""

    def steps(self) -> None:
        env = self.env
        self._keep_start()
        self.ctx.restart()
        slow = env.engine.capturable and env.device.is_cpu
        for i, action in enumerate(self.ctx.actions(min(self.ctx.steps, _FEW) if slow else self.ctx.steps)):
            ended = env.done.clone()
            if i == 0 or ended.any():
                self._run_reset()
                env.rand_reset(mask=ended)
            torch_view(self.rows["action"]).copy_(action)
            self._copy(self.worlds.after, self.before)
            self._run("control", self.before)
            self._copy(self.worlds.after, self.before)
            state = env.get_state()
            env.step(action)
            if (env.done_reason & int(FAULTS)).any():
                self._run_before_restart(state, action)
            self._run_step(self.worlds)

    def _run_before_restart(self, state: torch.Tensor, action: torch.Tensor) -> None:
        """Repeat a step that ended with a fault, because a read out of range may have caused the fault.

        If the fault is a reward or an observation, find the functions whose results are not finite.
        """
        env = self.ctx.b
        env.set_state(state)
        env.action.copy_(action)
        env.worlds.act()
        for phase in env.worlds.physics_phases():
            phase.run()
        self._run_step(env.worlds)
        found: list[tuple[Done, Sequence[str], wp.array | None]] = [(Done.REWARD, ["reward"], None)]
        if "score" in self.functions:
            found = [(Done.REWARD, self.env.task.metrics, self.rows["metrics"])]
        for group, space in self.worlds.obs_spaces.items():
            name = observer_name(group)
            found.append((Done.OBSERVATION, [f"{column} of {name}" for column in space.columns], self.obs[name]))
        for fault, names, rows in found:
            worlds = (self.env.done_reason & int(fault)) != 0
            if worlds.any():
                bad = [True] if rows is None else (~torch.isfinite(torch_view(rows)[worlds])).any(0).tolist()
                wrong = (name for name, is_bad in zip(names, bad, strict=True) if is_bad)
                self.not_finite |= dict.fromkeys(f"{name} is NaN or infinite" for name in wrong)

    def _run_step(self, worlds: Worlds) -> None:
        dirty = True
        for name, function in self.functions.items():
            if name in (*_RESET, "control"):
                continue
            if dirty:
                self._copy(worlds.after, self.after)
            if name == "advance":  # advance gets the memory of the previous step
                for memory in MEMORIES:
                    if memory in self.env.task.types:
                        wp.copy(getattr(self.after, memory), getattr(self.before, memory))
            self._run(name, self.after)
            dirty = name == "advance" or bool(written_fields(function))

    def _run_reset(self) -> None:
        self._copy(self.start, self.after)
        if "lasting_memory" in self.env.task.types:
            wp.copy(self.after.lasting_memory, self.worlds.after.lasting_memory)
        for name in _RESET:
            self._run(name, self.after)

    def _keep_start(self) -> None:
        env = self.ctx.b
        env.engine.reset(env.worlds.everyone)
        self._copy(env.worlds.after, self.start)
        for memory in MEMORIES:
            if memory in env.task.types:
                getattr(self.start, memory).zero_()
        env.reset()

    def _run(self, name: str, state: Any) -> None:
        if name not in self.functions:
            return
        draws = self.rng.integers(0, 2**32, (self.env.nworld, 1), dtype=np.uint32)
        self.rows["rng"].assign(draws)
        values = {"s": state, "s0": self.before, "s1": state, "p": self.worlds.params} | self.rows
        values["weights"] = self.worlds.weights
        if name in self.obs:
            values["obs"] = self.obs[name]
        types = self.functions[name].input_types
        form = FUNCTIONS.get("observe" if name in self.obs else name)
        # generated functions have their own argument names
        names = form.argument_names[: len(types)] if form else types
        given = [values[argument] for argument in names]
        kernel = self.checked.kernels[name]
        wp.launch(kernel, self.env.nworld, [self.report, *given], device=self.env.device)

    def _batch(self) -> Any:
        batch = self.env.task.kernels.Batch()
        for name in self.env.task.types:
            live = getattr(self.worlds.after, name)
            setattr(batch, name, self._array(live.shape, live.dtype))
        if self.env.task.shared:
            batch.shared = self.worlds.shared
        return batch

    def _array(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Make an array. Even an empty array gets memory, because checked functions replace a bad index by 0."""
        with wp.ScopedDevice(self.env.device):
            made: wp.array = wp.zeros([max(size, 1) for size in shape], dtype=dtype)
            self.keep.append(made)
            return (
                made if made.shape == shape else wp.array(ptr=made.ptr, shape=shape, strides=made.strides, dtype=dtype)
            )

    def _copy(self, source: Any, target: Any) -> None:
        for name in self.env.task.types:
            array = getattr(source, name)
            if array.size:
                wp.copy(getattr(target, name), array)
