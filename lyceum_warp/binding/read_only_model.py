"""Copy a compiled model for its user, and refuse edits, which the engine's own copy would not see."""

from typing import Any

import mujoco
import numpy as np


def _refuse(self: Any, name: str, value: Any) -> None:
    raise AttributeError(
        "env.model is read-only, because the engine has a copy of its own: list model fields in the task's World and "
        "write them in startup or randomize, or pass an edited MjSpec as model="
    )


class _Part:
    """A read-only part of a model, such as ``model.opt`` or ``model.body("torso")``."""

    def __init__(self, part: Any) -> None:
        object.__setattr__(self, "_part", part)

    def __getattr__(self, name: str) -> Any:
        if name == "_part":  # not set yet, as in a copy
            raise AttributeError(name)
        value = getattr(self._part, name)
        return _locked(value.view()) if isinstance(value, np.ndarray) else value

    __setattr__ = _refuse

    def __repr__(self) -> str:
        return repr(self._part)


def _locked(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


class ReadOnlyModel(mujoco.MjModel):  # type: ignore[misc]
    """A compiled model whose fields and options cannot be changed. ``copy.copy(model)`` is an ordinary MjModel."""

    __setattr__ = _refuse

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        for name in dir(mujoco.MjModel):
            if isinstance(array := getattr(self, name), np.ndarray):
                _locked(array)


def _part(get: Any) -> property:
    return property(lambda model: _Part(get(model)))


def _finder(find: Any) -> Any:
    return lambda model, *key: _Part(find(model, *key))


for _name in ("opt", "stat"):
    setattr(ReadOnlyModel, _name, _part(getattr(mujoco.MjModel, _name).__get__))
for (
    _name
) in "actuator body cam camera eq equality geom jnt joint key keyframe light mat pair sensor site tendon".split():
    setattr(ReadOnlyModel, _name, _finder(getattr(mujoco.MjModel, _name)))


def read_only(model: mujoco.MjModel) -> ReadOnlyModel:
    """A copy of a model that refuses edits."""
    copy = ReadOnlyModel.__new__(ReadOnlyModel)
    copy.__setstate__(model.__getstate__())
    return copy
