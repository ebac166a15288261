"""Make all kernels that call a task's functions."""

from types import SimpleNamespace
from typing import Any

from lyceum_warp.kernels import resets, rollouts, shared_memory, steps, transitions
from lyceum_warp.kernels.step_types import TaskCode


class Kernels(SimpleNamespace):
    """The kernels of a step by name; kernels that the task does not need are None."""

    Batch: Any
    Transition: Any
    Observations: Any


def make_kernels(task: TaskCode) -> Kernels:
    """Make all kernels of a task."""
    steps.make_step_kernels(task)
    transitions.make_transition_kernels(task)
    resets.make_reset_kernels(task)
    rollouts.make_rollout_kernels(task)
    shared_memory.make_shared_memory_kernels(task)
    structs = {"Batch": task.Batch, "Transition": task.Transition, "Observations": task.Observations}
    return Kernels(**task.kernels, **structs)
