"""Kernels made of a task's functions: once for the same functions, under the same name in every process."""

from pathlib import Path

import tiny_task

from lyceum_warp.binding.codegen import kernels_of
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.registry import find_task, task_name

EVALUATE = "def evaluate(s: World, p: Params) -> float:\n    return s.qpos[1]"


def source_of(file: Path | str) -> TaskSource:
    task = find_task(file)
    return TaskSource(task, task_name(task))


def test_the_same_functions_share_their_kernels(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Slower(Tiny):\n    frame_skip = 2\n")
    first, second = (source_of(f"{file}:{name}") for name in ("Tiny", "Slower"))
    assert kernels_of(first) is kernels_of(second) is kernels_of(source_of(f"{file}:Tiny"))


def test_another_function_makes_other_kernels(tmp_path: Path) -> None:
    other = f"{tiny_task.with_function(EVALUATE.replace('evaluate', 'height'))}\nclass Other(Tiny):\n"
    file = tiny_task.write(tmp_path, f"{other}    evaluate = height\n")
    assert kernels_of(source_of(f"{file}:Tiny")) is not kernels_of(source_of(f"{file}:Other"))


def test_the_batch_has_every_field_of_world_with_one_more_axis(tmp_path: Path) -> None:
    fields = "time: float\n    qpos: Row[float]\n    xpos: Row[wp.vec3]"
    kernels = kernels_of(source_of(tiny_task.write(tmp_path, tiny_task.changed(("qpos: Row[float]", fields)))))
    axes = {name: variable.type.ndim for name, variable in kernels.Batch.vars.items()}
    assert axes == {"time": 1, "qpos": 2, "xpos": 2}


def test_memory_is_advanced_only_by_a_task_that_writes_it(tmp_path: Path) -> None:
    kernels = kernels_of(source_of(tiny_task.write(tmp_path, tiny_task.TINY)))
    assert kernels.advance_memory is kernels.advance_rows is None
    advance = "def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):\n    pass"
    kernels = kernels_of(source_of(tiny_task.write(tmp_path, tiny_task.with_function(advance), "advancing.py")))
    assert kernels.advance_memory is not None and kernels.advance_rows is not None


def test_a_module_of_kernels_has_the_same_name_until_its_task_is_made_again(tmp_path: Path) -> None:
    """Warp finds compiled kernels by the module's name."""
    file = tiny_task.write(tmp_path, tiny_task.TINY)
    first = kernels_of(source_of(file)).judge.module.name
    assert first == f"lyceum_warp.generated.{find_task(file).__module__}.Tiny"
    tiny_task.write(tmp_path, tiny_task.with_function(EVALUATE))
    assert kernels_of(source_of(file)).judge.module.name == f"{first}_1"
