"""Copy a compiled model for the user, and refuse edits, because they would not reach the engine's copy."""

from typing import Any

import mujoco
import numpy as np

_BY_NAME = "actuator body cam camera eq equality geom jnt joint key keyframe light mat pair sensor site tendon".split()


def _refuse(self: Any, name: str, value: Any) -> None:
    raise AttributeError(
        "env.model is read-only, because the engine has its own copy: list model fields in the task's World and "
        "write them in startup or randomize, or pass an edited MjSpec as model="
    )


class _Part:
    """A read-only part of a model, such as ``model.opt`` or ``model.body("torso")``."""

    def __init__(self, part: Any) -> None:
        object.__setattr__(self, "_part", part)

    def __getattr__(self, name: str) -> Any:
        value = getattr(object.__getattribute__(self, "_part"), name)
        if isinstance(value, np.ndarray):
            value = value.view()
            value.flags.writeable = False
        return value

    __setattr__ = _refuse


class ReadOnlyModel(mujoco.MjModel):  # type: ignore[misc]
    """A compiled model whose fields and options cannot be changed. ``copy.copy(model)`` is an ordinary MjModel."""

    __setattr__ = _refuse

    def __getattribute__(self, name: str) -> Any:
        value = super().__getattribute__(name)
        if name in _BY_NAME:
            return lambda *key: _Part(value(*key))
        return _Part(value) if name in ("opt", "stat") else value

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        for name in dir(mujoco.MjModel):
            if isinstance(array := getattr(self, name), np.ndarray):
                array.flags.writeable = False


def read_only(model: mujoco.MjModel) -> ReadOnlyModel:
    """Copy a model. The copy refuses edits."""
    copy = ReadOnlyModel.__new__(ReadOnlyModel)
    copy.__setstate__(model.__getstate__())
    return copy
