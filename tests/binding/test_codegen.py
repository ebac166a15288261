"""Test that equal functions share their kernels, whose names are the same in every process."""

from pathlib import Path
from typing import Any

import tiny_task

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.registry import find_task

EVALUATE = "def evaluate(s: World, p: Params) -> float:\n    return s.qpos[1]"


def kernels(file: Path | str) -> Any:
    return BoundTask(find_task(file)).kernels


def test_the_same_functions_share_their_kernels(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Slower(Tiny):\n    frame_skip = 2\n")
    assert kernels(f"{file}:Tiny") is kernels(f"{file}:Slower") is kernels(f"{file}:Tiny")


def test_a_different_function_makes_different_kernels(tmp_path: Path) -> None:
    other = f"{tiny_task.with_function(EVALUATE.replace('evaluate', 'height'))}\nclass Other(Tiny):\n"
    file = tiny_task.write(tmp_path, f"{other}    evaluate = height\n")
    assert kernels(f"{file}:Tiny") is not kernels(f"{file}:Other")


def test_a_kernel_module_keeps_its_name_until_its_task_file_changes(tmp_path: Path) -> None:
    """Warp caches compiled kernels by the module's name."""
    file = tiny_task.write(tmp_path, tiny_task.TINY)
    first = kernels(file).judge.module.name
    assert first == f"lyceum_warp.generated.{find_task(file).__module__}.Tiny"
    tiny_task.write(tmp_path, tiny_task.with_function(EVALUATE))
    assert kernels(file).judge.module.name == f"{first}_1"
