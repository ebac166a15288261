from pathlib import Path
from typing import Any

import tiny_task

from lyceum_warp.binding import TaskSource, find_task
from lyceum_warp.binding.bound_task import BoundTask

EVALUATE = "def evaluate(s: World, p: Params) -> float:\n    return s.qpos[1]"


def kernels(file: Path | str) -> Any:
    return BoundTask(find_task(file)).kernels


def test_equal_functions_share_kernels(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, f"{tiny_task.TINY}\nclass Slower(Tiny):\n    frame_skip = 2\n")
    assert kernels(f"{file}:Tiny") is kernels(f"{file}:Slower") is kernels(f"{file}:Tiny")


def test_copied_task_file_shares_kernel_modules_until_it_changes(tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    file, copy = (tiny_task.write(folder, tiny_task.TINY) for folder in (tmp_path, tmp_path / "copy"))
    first = TaskSource(find_task(file), "tiny").kernel_name
    assert TaskSource(find_task(copy), "tiny").kernel_name == first
    assert kernels(file).judge.module.name.startswith(f"lyceum_warp.generated.{first}")
    tiny_task.write(tmp_path, tiny_task.with_function(EVALUATE))
    assert TaskSource(find_task(file), "tiny").kernel_name != first
