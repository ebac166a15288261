import sys
import types
from pathlib import Path

import pytest
import tiny_task
import torch

import lyceum_warp as lw
from lyceum_warp.binding import find_task, registry


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    module = types.ModuleType("notebook_of_a_test")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    return module


def run_cell(module: types.ModuleType, file: Path) -> None:
    exec(compile(file.read_text(), str(file), "exec"), vars(module))


def test_notebook_task_uses_the_functions_of_its_own_cell(notebook: types.ModuleType, tmp_path: Path) -> None:
    evaluate = "def evaluate(s: World, p: Params) -> float:\n    return 1.0"
    first = tiny_task.with_function(evaluate)
    second = tiny_task.changed(("s.qpos[0]", "2.0"), ("class Tiny", "class Other"))
    for i, cell in enumerate((first, second)):
        run_cell(notebook, tiny_task.write(tmp_path, cell, f"cell{i}.py"))  # Warp reads the source from a file
    tiny, other = lw.make(notebook.Tiny), lw.make(notebook.Other)
    for env in (tiny, other):
        env.step()
    assert tiny.eval.item() == 1.0
    assert torch.equal(tiny.obs, tiny.field("qpos")[:, :1])
    assert other.obs.item() == 2.0
    assert torch.equal(other.eval, other.reward)


def test_repeated_notebook_cell_replaces_its_registered_task(notebook: types.ModuleType, tmp_path: Path) -> None:
    cell = tiny_task.changed(("class Tiny", "@lw.register\nclass FromNotebook"))
    file = tiny_task.write(tmp_path, cell, "cell.py")
    run_cell(notebook, file)
    first = notebook.FromNotebook
    run_cell(notebook, file)
    assert find_task("from_notebook") is notebook.FromNotebook is not first
