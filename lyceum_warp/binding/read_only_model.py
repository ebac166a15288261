"""An environment's compiled model as its user sees it: a ``mujoco.MjModel`` that refuses edits.

The engines keep copies of the model, so an edit of it would change nothing. Here it raises an error that says what to
do instead. MuJoCo's own functions take such a model like any other.
"""

import enum
from typing import Any

import mujoco
import numpy as np

_REFUSAL = (
    "env.model is read-only, because the physics has its own copy: list the model field in World and write it in "
    "startup or randomize, or pass an edited MjSpec as model="
)


def _refuse(*args: Any, **words: Any) -> Any:
    raise AttributeError(_REFUSAL)


class ReadOnlyArray(np.ndarray):
    """An array of a model, which refuses edits. What is copied or calculated from it can be edited."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = (), **words: Any) -> Any:
        """Calculate with ordinary arrays."""
        if any(isinstance(array, ReadOnlyArray) and not array.flags.writeable for array in out):
            _refuse()
        if out:
            words["out"] = tuple(map(_plain, out))
        return getattr(ufunc, method)(*map(_plain, inputs), **words)

    def __setitem__(self, where: Any, value: Any) -> None:
        if not self.flags.writeable:
            _refuse()
        super().__setitem__(where, value)

    fill = put = sort = partition = setflags = _refuse

    def copy(self, order: Any = "C") -> Any:
        """An ordinary array with the same values."""
        return np.array(self, order=order)

    def __copy__(self) -> Any:
        return self.copy()

    def __deepcopy__(self, memo: Any) -> Any:
        return self.copy()

    def __reduce__(self) -> Any:
        return self.copy().__reduce__()


def _plain(value: Any) -> Any:
    return value.view(np.ndarray) if isinstance(value, ReadOnlyArray) else value


class _Part:
    """A part of a model, such as ``model.opt`` or ``model.body("torso")``, that can be read alone."""

    __slots__ = ("_part",)

    def __init__(self, part: Any) -> None:
        object.__setattr__(self, "_part", part)

    def __getattr__(self, name: str) -> Any:
        return _shown(getattr(self._part, name))

    __setattr__ = __delattr__ = _refuse

    def __dir__(self) -> Any:
        return dir(self._part)

    def __repr__(self) -> str:
        return repr(self._part)

    def __eq__(self, other: object) -> bool:
        return bool(self._part == (other._part if isinstance(other, _Part) else other))

    __hash__ = None  # type: ignore[assignment]


_PLAIN = (int, float, bytes, str, tuple, type(None), enum.Enum, np.generic)
_NAMED = frozenset(
    "actuator bind body cam camera eq equality exclude geom hfield jnt joint key keyframe light mat material mesh "
    "numeric pair sensor site skin tendon tex texture tuple".split()
)


def _shown(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        view = value.view()
        view.flags.writeable = False
        return view.view(ReadOnlyArray)
    return value if isinstance(value, _PLAIN) or callable(value) else _Part(value)


_read = mujoco.MjModel.__getattribute__


class ReadOnlyModel(mujoco.MjModel):  # type: ignore[misc]
    """A compiled model that refuses edits. ``copy.copy(model)`` is an ordinary ``mujoco.MjModel``, which takes them."""

    __slots__ = ()

    def __getattribute__(self, name: str) -> Any:
        value = _read(self, name)
        if type(value) is int:  # sizes, which are read the most
            return value
        if name in _NAMED:
            return lambda *args: _Part(value(*args))
        return value if name.startswith("_") else _shown(value)

    __setattr__ = __delattr__ = _refuse


def read_only(model: mujoco.MjModel) -> ReadOnlyModel:
    """A copy of a model that refuses edits."""
    copy = ReadOnlyModel.__new__(ReadOnlyModel)
    copy.__setstate__(model.__getstate__())
    return copy
