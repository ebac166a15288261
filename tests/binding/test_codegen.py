"""Kernels made of a task's functions: once for the same functions, under the same name in every process."""

from pathlib import Path
from typing import Any

import pytest
import tiny_task

from lyceum_warp.binding.codegen import kernels_of
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.registry import find_task, task_name
from lyceum_warp.task import FUNCTIONS

EVALUATE = "def evaluate(s: World, p: Params) -> float:\n    return s.qpos[1]"


def source_of(file: Path | str) -> TaskSource:
    task = find_task(file)
    return TaskSource(task, task_name(task))


def kernels(file: Path | str) -> Any:
    source = source_of(file)
    return kernels_of(source, source.group_functions(["policy"]))


def test_the_same_functions_share_their_kernels(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Slower(Tiny):\n    frame_skip = 2\n")
    assert kernels(f"{file}:Tiny") is kernels(f"{file}:Slower") is kernels(f"{file}:Tiny")


def test_another_function_makes_other_kernels(tmp_path: Path) -> None:
    other = f"{tiny_task.with_function(EVALUATE.replace('evaluate', 'height'))}\nclass Other(Tiny):\n"
    file = tiny_task.write(tmp_path, f"{other}    evaluate = height\n")
    assert kernels(f"{file}:Tiny") is not kernels(f"{file}:Other")


def test_the_batch_has_every_field_of_world_with_one_more_axis(tmp_path: Path) -> None:
    fields = "time: float\n    qpos: Row[float]\n    xpos: Row[wp.vec3]"
    found = kernels(tiny_task.write(tmp_path, tiny_task.changed(("qpos: Row[float]", fields))))
    axes = {name: variable.type.ndim for name, variable in found.Batch.vars.items()}
    assert axes == {"time": 1, "qpos": 2, "xpos": 2}


OPTIONAL = {
    "control": ("control_worlds",),
    "measure": ("measure_worlds",),
    "advance": ("advance_memory", "advance_rows"),
    "substep": ("substep_memory",),
    "startup": ("start_worlds",),
    "reject": ("reject_worlds",),
    "event": ("run_events",),
}


@pytest.mark.parametrize("name", OPTIONAL)
def test_a_kernel_exists_only_for_a_task_with_its_function(name: str, tmp_path: Path) -> None:
    without = kernels(tiny_task.write(tmp_path, tiny_task.TINY))
    assert all(getattr(without, kernel) is None for kernel in OPTIONAL[name])
    function = f"def {FUNCTIONS[name].signature}:\n    {FUNCTIONS[name].default}"
    found = kernels(tiny_task.write(tmp_path, tiny_task.with_function(function), "more.py"))
    assert all(getattr(found, kernel) is not None for kernel in OPTIONAL[name])


def test_a_module_of_kernels_has_the_same_name_until_its_task_is_made_again(tmp_path: Path) -> None:
    """Warp finds compiled kernels by the module's name."""
    file = tiny_task.write(tmp_path, tiny_task.TINY)
    first = kernels(file).judge.module.name
    assert first == f"lyceum_warp.generated.{find_task(file).__module__}.Tiny"
    tiny_task.write(tmp_path, tiny_task.with_function(EVALUATE))
    assert kernels(file).judge.module.name == f"{first}_1"
