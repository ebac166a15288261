"""The model of the world that is shown, where worlds differ."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np

SEEN = (
    "geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_matid", "geom_dataid", "geom_group", "site_", "body_pos",
    "body_quat", "jnt_pos", "jnt_axis", "qpos0", "mat_", "tendon_rgba", "tendon_width", "cam_", "light_", "hfield_",
    "mesh_", "skin_", "flex_",
)  # fmt: skip
"""What the names of fields begin with that change the picture."""

LISTED = 8
"""Elements of a field that are listed."""


class ModelValues:
    """A model with the values of one world.

    Args:
        nominal: The model without them, which is copied.

    """

    def __init__(self, nominal: mujoco.MjModel) -> None:
        self._nominal = nominal
        self._values: dict[str, np.ndarray] = {}
        self.model = copy.deepcopy(nominal)
        """The model with them."""
        self.differences: list[tuple[str, str]] = []
        """What differs from the nominal model: an element's name and its value, with the nominal one."""

    def differ(self, values: Mapping[str, np.ndarray]) -> bool:
        """Whether other values than those now are given."""
        return values.keys() != self._values.keys() or any(
            not np.array_equal(values[name], self._values[name]) for name in values
        )

    def set(self, values: Mapping[str, np.ndarray]) -> bool:
        """Take a world's values; whether the picture changes, and not just masses, for example."""
        seen = any(
            name.startswith(SEEN)
            and not (name in values and name in self._values and np.array_equal(values[name], self._values[name]))
            for name in {*values, *self._values}
        )
        self._values = {name: np.array(value) for name, value in values.items()}
        self.model = copy.deepcopy(self._nominal)
        self.copy_to(self.model)
        self.differences = self._described()
        return seen

    def copy_to(self, model: mujoco.MjModel) -> None:
        """Set the values in another copy of the model, and what follows from them."""
        for name in self._values:
            field(model, name)[...] = self._values[name].reshape(field(model, name).shape)
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def _described(self) -> list[tuple[str, str]]:
        lines = []
        for name, values in self._values.items():
            nominal = np.array(field(self._nominal, name))
            values = values.reshape(nominal.shape)
            rows = [i for i in range(len(nominal)) if not np.array_equal(values[i], nominal[i])]
            for i in rows[:LISTED]:
                lines.append((f"{name} {self._element(name, i)}", f"{short(values[i])} ({short(nominal[i])})"))
            if len(rows) > LISTED:
                lines.append((name, f"and {len(rows) - LISTED} others"))
        return lines

    def _element(self, name: str, i: int) -> str:
        """The name of a field's element, or its number."""
        kind = {"dof": "", "jnt": "joint", "mat": "material"}.get(name.partition("_")[0], name.partition("_")[0])
        accessor = getattr(self._nominal, kind, None) if kind else None
        return (accessor(i).name if callable(accessor) else "") or str(i)


def field(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field of a model or of its options, as an array that can be written to."""
    owner = model if hasattr(model, name) else model.opt
    return np.atleast_1d(getattr(owner, name))


def short(value: np.ndarray) -> str:
    """A value in few characters."""
    return " ".join(f"{number:.4g}" for number in np.ravel(value))
