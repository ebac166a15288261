"""Hold the environments under test, and compare their values."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import numpy as np
import torch

from lyceum_warp.core import FAULTS
from lyceum_warp.env import Env
from lyceum_warp.kernels import step_types
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.support.docstrings import document_attributes

OUTCOMES = (*step_types.OUTCOMES, "obs", "final_obs")
"""Buffers that a step fills."""

SHORT = 8


@document_attributes
@dataclasses.dataclass
class Context:
    """Two environments with the same options, and methods that compare their values.

    Before each check, both environments are in the same random initial states.
    A method's error names the rule that the task breaks.
    """

    a: Env
    """The environment of most checks."""
    b: Env
    make: Callable[..., Env]
    """Makes another environment with the same options, except for given changes."""
    steps: int
    seed: int
    rule: str = ""

    def fail(self, problem: str, world: int = 0) -> NoReturn:
        """Raise an AssertionError with the seed, and with the step and the state of a world of ``a``."""
        state, parts = self.a.get_state()[world], self.a.state_space.parts
        values = ", ".join(f"{name} {state[part].tolist()}" for name, part in parts.items())
        where = f"with seed {self.seed}, world {world} in step {int(state[parts['step']])} of its episode: {values}"
        what = f"{self.a.task.name} on the {self.a.engine.name} engine breaks the rule {self.rule!r}: {problem}"
        raise AssertionError(f"{what}\n  {where}")

    def that(self, holds: bool | torch.Tensor, problem: str) -> None:
        """Fail unless a condition holds."""
        if not bool(holds):
            self.fail(problem)

    def equal(self, actual: torch.Tensor, wanted: torch.Tensor, what: str) -> None:
        """Fail unless two tensors have the same shape and type, and are equal bit for bit (NaN equals NaN)."""
        if actual.shape != wanted.shape or actual.dtype != wanted.dtype:
            self.fail(f"{what}: {actual.dtype} {tuple(actual.shape)} instead of {wanted.dtype} {tuple(wanted.shape)}")
        differ = ~((actual == wanted) | ((actual != actual) & (wanted != wanted)))
        if differ.any():
            first = tuple(differ.nonzero()[0].tolist())
            axis = next((i for i, size in enumerate(actual.shape) if size == self.a.nworld), None)
            self.fail(
                f"{what}: {int(differ.sum())} of {differ.numel()} values differ, the first at {first}: "
                f"{actual[first].item()!r} instead of {wanted[first].item()!r}",
                world=0 if axis is None else first[axis],
            )

    def restart(self, seed: int | None = None) -> None:
        """Put both environments into the same random initial states."""
        for env in (self.a, self.b):
            env.rand_reset(self.seed if seed is None else seed)

    def actions(self, steps: int, salt: int = 0) -> torch.Tensor:
        """Draw random actions, (steps, nworld, nact). Infinite bounds are replaced by -1 and 1."""
        env = self.a
        assert env.action_space.low is not None and env.action_space.high is not None
        low = torch.as_tensor(np.where(np.isfinite(env.action_space.low), env.action_space.low, -1.0))
        high = torch.as_tensor(np.where(np.isfinite(env.action_space.high), env.action_space.high, 1.0))
        generator = torch.Generator().manual_seed(self.seed + 1000 * salt + 1)
        draws = torch.rand(steps, *env.action.shape, generator=generator)
        return (low + draws * (high - low)).to(env.action)

    def mask(self, *worlds: int) -> torch.Tensor:
        """Return a mask of the given worlds, by default every second world, (nworld,) bool."""
        numbers = torch.arange(self.a.nworld)
        mask = torch.isin(numbers, torch.tensor(worlds)) if worlds else numbers % 2 == 0
        return mask.to(self.a.action.device)

    def faulty(self, env: Env) -> torch.Tensor:
        """Return a mask of the worlds with a fault in the last step, (nworld,) bool."""
        return (env.done_reason & int(FAULTS)) != 0

    def calm(self, env: Env) -> torch.Tensor:
        """Return a mask of the worlds that ``event`` left unchanged after the last step, (nworld,) bool."""
        if env.task.functions["event"] is None:
            return torch.ones_like(env.done)
        return ~env.worlds.changed_view

    def run(self, env: Env, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """Apply actions, and return the states and results of all steps, (steps, nworld, ...)."""
        series: dict[str, list[torch.Tensor]] = {name: [] for name in ("state", "calm", *OUTCOMES)}
        for action in actions:
            env.step(action)
            series["state"].append(env.get_state())
            series["calm"].append(self.calm(env))
            for name in OUTCOMES:
                series[name].append(getattr(env, name).clone())
        return {name: torch.stack(values) for name, values in series.items()}

    def same_runs(self, actual: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor], what: str) -> None:
        """Fail unless two results of ``run`` are equal bit for bit."""
        for name in wanted:
            self.equal(actual[name], wanted[name], f"{name} {what} (step, world, ...)")

    def same_worlds(self, mask: torch.Tensor, what: str) -> None:
        """Fail unless the results and the states of selected worlds are equal in both environments."""
        for name in OUTCOMES:
            self.equal(getattr(self.a, name)[mask], getattr(self.b, name)[mask], f"{name} of {what}")
        self.equal(self.a.get_state()[mask], self.b.get_state()[mask], f"the state of {what}")

    @contextlib.contextmanager
    def changed(self, *envs: Env, **choices: Any) -> Iterator[None]:
        """Change ``horizon``, ``autoreset`` or ``graphs`` of environments until the context exits."""
        settings: list[Any] = [
            {"horizon": env.horizon, "autoreset": env.autoreset, "graphs": env.worlds.programs.graphs.enabled}
            for env in envs
        ]
        try:
            for env, values in zip(envs, settings, strict=True):
                env.worlds.configure(**(values | choices))
            yield
        finally:
            for env, values in zip(envs, settings, strict=True):
                env.worlds.configure(**values)

    def buffers(self, env: Env) -> dict[str, torch.Tensor]:
        """Copy an environment's buffers, fields and state."""
        shown = {name: getattr(env, name).clone() for name in (*OUTCOMES, "action", "time")}
        fields = {f"field {name}": torch_view(array).clone() for name, array in env.engine.arrays.items()}
        return shown | fields | {"state": env.get_state()}

    def finite(self, env: Env, when: str) -> None:
        """Fail unless the state and all results are finite."""
        for name, values in {"state": env.get_state(), **{k: getattr(env, k) for k in OUTCOMES}}.items():
            self.that(torch.isfinite(values).all(), f"{name} is not finite {when}: {values}")
