"""Compile kernels for a GPU. This needs Warp's compiler but no GPU."""

import pkgutil
from importlib import import_module
from pathlib import Path

import pytest
import warp as wp
from full_task import Full
from terms_variant import Variant

import lyceum_warp as lw
from lyceum_warp import kernels

NAMES = [name for _, name, _ in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}.")]


def kernels_of(values: object) -> list[wp.Kernel]:
    return [value for value in vars(values).values() if isinstance(value, wp.Kernel)]


SHARED = [made for name in NAMES if (made := [k for k in kernels_of(import_module(name)) if k.module.name == name])]


def compiled(module: wp.Module, folder: Path) -> str:
    if not (archs := wp.get_cuda_supported_archs()):
        pytest.skip("this build of Warp does not compile for GPUs")
    (made,) = wp.compile_aot_module(module, arch=archs[0], module_dir=folder, use_ptx=True)
    return Path(made).read_text()


def entries(code: str) -> int:
    return code.count(".visible .entry ")


@pytest.mark.parametrize("made", SHARED, ids=lambda made: made[0].module.name)
def test_shared_kernels_compile_for_a_gpu(made: list[wp.Kernel], tmp_path: Path) -> None:
    assert entries(compiled(made[0].module, tmp_path)) == len(made)


@pytest.mark.quick("Variant")
@pytest.mark.parametrize("task", [Full, Variant, *lw.task_names()])
def test_kernels_of_a_task_compile_for_a_gpu(task: type[lw.Task] | str, tmp_path: Path) -> None:
    made = kernels_of(lw.make(task, engine="mujoco").task.kernels)
    assert entries(compiled(made[0].module, tmp_path)) == len(made)
