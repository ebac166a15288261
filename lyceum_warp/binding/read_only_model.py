"""Copy a compiled model for its user so that edits, which the engines' own copies would not see, raise an error."""

from typing import Any

import mujoco
import numpy as np

_REFUSAL = (
    "env.model is read-only, because the physics has its own copy: list the model field in World and write it in "
    "startup or randomize, or pass an edited MjSpec as model="
)


def _refuse(self: Any, name: str, value: Any) -> None:
    raise AttributeError(_REFUSAL)


class _Options:
    """The options of a model, ``model.opt``."""

    def __init__(self, options: mujoco.MjOption) -> None:
        object.__setattr__(self, "_options", options)

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "_options"), name)

    __setattr__ = _refuse


class ReadOnlyModel(mujoco.MjModel):  # type: ignore[misc]
    """A compiled model whose fields and options cannot be assigned. ``copy.copy(model)`` is an ordinary MjModel."""

    __slots__ = ()
    opt = property(lambda self: _Options(mujoco.MjModel.opt.__get__(self)))
    __setattr__ = _refuse


def read_only(model: mujoco.MjModel) -> ReadOnlyModel:
    """A copy of a model whose arrays are read-only, too."""
    copy = ReadOnlyModel.__new__(ReadOnlyModel)
    copy.__setstate__(model.__getstate__())
    for part in (copy, copy.opt._options):
        for name in dir(part):
            if isinstance(array := getattr(part, name), np.ndarray):
                array.flags.writeable = False
    return copy
