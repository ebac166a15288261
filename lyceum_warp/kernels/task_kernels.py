"""Make all kernels that call a task's functions."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import warp as wp

from lyceum_warp.kernels import resets, rollouts, shared_memory, steps, transitions
from lyceum_warp.kernels.step_types import TaskCode


class Kernels(SimpleNamespace):
    """The kernels of a step by name; kernels that the task does not need are None."""

    views: Mapping[Any, wp.Function]
    """The functions that make the structs of the task.

    World is made from a batch and a world's index. The other structs are made from a row of floats.
    """
    terms: Mapping[str, wp.Function]
    """The generated functions of a task with terms: ``reward``, ``score`` and ``terminated``."""
    Batch: Any
    Observations: Any


_MAKERS = (
    steps.make_keep_before,
    steps.make_act,
    steps.make_check_model,
    steps.make_substep_memory,
    steps.make_advance_memory,
    steps.make_run_events,
    transitions.make_check_memory,
    transitions.make_judge,
    transitions.make_conclude,
    transitions.make_observe_worlds,
    transitions.make_replace_observations,
    resets.make_start_worlds,
    resets.make_restart,
    resets.make_reject_worlds,
    rollouts.make_judge_rows,
    rollouts.make_advance_rows,
    shared_memory.make_tally_worlds,
    shared_memory.make_share_memory,
)


def make_kernels(task: TaskCode) -> Kernels:
    """Make all kernels of a task."""
    for make in _MAKERS:
        make(task)
    return Kernels(**task.kernels, views=task.views, terms=task.terms, Batch=task.Batch, Observations=task.Observations)
