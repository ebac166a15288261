"""Store the list that lyceum-warp tasks prints: python docs/task_list.py."""

import inspect
import json
import sys
from pathlib import Path
from typing import Any

from lyceum_warp import binding, core
from lyceum_warp.cli.list_tasks import LIST


def read_task(name: str) -> dict[str, Any]:
    """Make the row of a task from its class and its model."""
    task = binding.find_task(name)
    source, spec = binding.TaskSource(task), binding.task_spec(task)
    params = binding.defaults(source.params, source.defaults)
    (obs, _), actions = binding.observation_layouts(source, params), binding.action_sizes(source, params)
    model: Any = task.model() if callable(task.model) else task.model
    file: Any = core.find_model(model, task) if isinstance(model, str | Path) else model
    from_package, has_file = isinstance(file, core.ModelFile), isinstance(file, core.ModelFile | Path)
    module = task.__module__.rpartition(".")[2]
    return {
        "obs": sum(obs["policy"].values()),
        "act": len(spec.actuators) if actions is None else sum(actions.values()),
        "skip": task.frame_skip,
        "dt": float(f"{spec.option.timestep * task.frame_skip:g}"),
        "horizon": task.horizon,
        "model": _model(file) if has_file else f"made in {module}.py",
        "about": _description(task),
        "files": {"packages": file.packages if from_package else [], "install": file.install if from_package else ""},
    }


def _model(file: Any) -> str:
    if isinstance(file, Path):
        return file.name
    extra = file.install.partition("[")[2].partition("]")[0]
    return f"{file.source} [{extra}]" if extra else f"{file.source}: {Path(file.file).name}"


def _description(task: Any) -> str:
    text = vars(task).get("__doc__") or inspect.getdoc(sys.modules[task.__module__]) or ""
    line = text.partition("\n")[0].rstrip(".")
    physics = f" (physics: {', '.join(task.physics)})" if task.physics else ""
    return f"{line.partition(': ')[2] or line}{physics}"


if __name__ == "__main__":
    lines = (f'"{name}": {json.dumps(read_task(name), ensure_ascii=False)}' for name in binding.package_task_names())
    LIST.write_text("{\n" + ",\n".join(sorted(lines)) + "\n}\n", "utf-8")
