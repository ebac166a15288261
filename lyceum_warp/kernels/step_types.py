"""Define the structs of a step's arrays, and collect the functions of a task that the kernels of a step call."""

import dataclasses
from collections.abc import Callable, Collection
from types import SimpleNamespace
from typing import Any

import warp as wp


@wp.struct
class Counters:
    """Counters and random streams of the worlds. Arrays have the shape (nworld,) unless noted."""

    step: wp.array[int]
    """Steps since the reset."""
    key: wp.array[wp.uint32]
    """Key of the world's random streams."""
    episode: wp.array[int]
    """Index of the episode."""
    rng: wp.array2d[wp.uint32]
    """Streams from which a task's functions draw, (observation groups * nworld, 1): one row per thread that draws.
    Every kernel resets the streams to their start."""


@wp.struct
class Outcome:
    """The outcome of a step in each world. Arrays have the shape (nworld,), and metrics (nworld, nmetrics)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    truncated: wp.array[bool]
    success: wp.array[bool]
    done: wp.array[bool]
    done_reason: wp.array[int]
    metrics: wp.array2d[float]
    episode_metrics: wp.array2d[float]


@wp.struct
class Findings:
    """Results of ``judge``, before it is known whether a world has a fault. Arrays have the shape (nworld,)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    truncated: wp.array[bool]
    success: wp.array[bool]
    fault: wp.array2d[int]
    """Bits of the faults, one row for each part of ``judge``, (parts, nworld)."""


@wp.struct
class Episodes:
    """The rules and the counts of the worlds' episodes."""

    horizon: int
    """The time limit in steps, or 0 for none."""
    success_steps: int
    """Number of successful steps in a row that an episode needs."""
    success_count: wp.array2d[float]
    """Successful steps in a row so far, (nworld, 1), if an episode needs several."""
    metric_sum: wp.array2d[float]
    """Sums of the metrics, (nworld, nmetrics)."""
    fault_count: wp.array2d[int]
    """Number of faults since the construction, (nworld, bits of Done)."""
    restart: wp.array[bool]
    """Whether the world begins a new episode, (nworld,)."""


OUTCOMES = {name: field.type.dtype for name, field in Outcome.vars.items() if field.type.ndim == 1}
"""The fields of Outcome with the shape (nworld,), and their types."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskCode:
    """A task's structs and functions, and the functions that are generated from them.

    Without ``control``, actions are scaled and shifted to controls. Without ``evaluate``, the evaluation is the reward.
    """

    module: str
    functions: SimpleNamespace  # the task's functions, including defaults
    written: Collection[str]  # names of the functions that the task defines
    World: Any
    Params: Any
    Batch: Any  # the task's fields in all worlds
    Transition: Any  # before, after, params, weights, action and counters of a step in all worlds
    Observations: Any  # the observation groups
    view: wp.Function  # (batch, world) -> World
    params_of: wp.Function  # (transition, world) -> Params
    view_Shared: wp.Function | None = None  # noqa: N815 (row of floats) -> Shared
    view_Sums: wp.Function | None = None  # noqa: N815 (row of floats) -> Sums
    copy_state: wp.Function | None = None  # copies the fields that change in a step, if there are any
    observe_group: wp.Function  # writes an observation group, and returns whether it is valid
    copy_observations: wp.Function
    finite_memory: wp.Function | None = None  # whether the task's memory is finite, if there is any
    valid_model: wp.Function | None = None  # whether the model fields that the task writes are valid, if it writes any
    terms: SimpleNamespace  # the generated functions ``reward`` and ``score`` of a task with terms
    kernels: dict[str, wp.Kernel | None] = dataclasses.field(default_factory=dict, init=False)

    def kernel(self, needed: bool = True) -> Callable[[Any], Any]:
        """Return a decorator that turns a function into a kernel of the task's Warp module.

        The decorator stores the kernel in ``kernels``. If the kernel is not needed, the decorator stores None.
        """

        def add(body: Any) -> None:
            made = wp.kernel(module=self.module, enable_backward=False)(body) if needed else None
            self.kernels[body.__name__] = made

        return add

    def kernel_for(self, function: str) -> Callable[[Any], Any]:
        """Return the decorator for a kernel that is needed only if the task defines ``function``."""
        return self.kernel(function in self.written)
