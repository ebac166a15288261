"""Compute the pose that a task shows as a transparent robot, such as the reference of a clip."""

from types import SimpleNamespace

import numpy as np

from lyceum_warp.env import Env

REFERENCE = (0.25, 0.75, 0.45, 0.4)
"""Red, green, blue and opacity."""


def reference_states(env: Env, state: np.ndarray) -> list[np.ndarray]:
    """Return the integration state of the pose that belongs to a state, or nothing if the task has no ``ghost``."""
    if (ghost := env.task.definition.ghost) is None:
        return []
    parts, pose = env.state_space.parts, state[: env.engine.integration_size].copy()
    pose[parts["qpos"]] = ghost(SimpleNamespace(**env.task.params), {name: state[parts[name]] for name in parts})
    return [pose]
