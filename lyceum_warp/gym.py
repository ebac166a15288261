"""Register all tasks with Gymnasium: ``gymnasium.make_vec("lyceum_warp.gym:lyceum/Hopper-v0", num_envs=64)``.

Importing this module registers each task under its class name, such as ``lyceum/HalfCheetah-v0``. ``register`` adds a
task of your own.
"""

import re
from pathlib import Path

import gymnasium

from lyceum_warp.adapters import GymnasiumEnv, GymnasiumVectorEnv
from lyceum_warp.binding import find_task, task_name, task_names
from lyceum_warp.core import Task

__all__ = ["GymnasiumEnv", "GymnasiumVectorEnv", "register"]


def register(task: str | Path | type[Task]) -> str:
    """Register a task with Gymnasium, and return its id, such as "lyceum/MyHopper-v0".

    An older task with the same id is replaced.

    Args:
        task: A task's name, file or class.

    Raises:
        ValueError: The task does not exist.
        FileNotFoundError: The task file does not exist.
    """
    registered = isinstance(task, str) and task in task_names()
    name = str(task) if registered else task_name(find_task(task))
    id = f"lyceum/{''.join(map(str.capitalize, re.split('[_/]', name)))}-v0"
    gymnasium.registry.pop(id, None)  # Gymnasium warns about an id that is registered twice
    gymnasium.register(
        id,
        entry_point="lyceum_warp.gym:GymnasiumEnv",
        vector_entry_point="lyceum_warp.gym:GymnasiumVectorEnv",
        kwargs={"task": name if registered else find_task(task)},
    )
    return id


for _task in task_names():
    register(_task)
