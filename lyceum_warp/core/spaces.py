"""Describe the shapes, parts and bounds of observations, actions and states."""

import dataclasses
from collections.abc import Iterable, Mapping

import mujoco
import numpy as np
import torch

from lyceum_warp.core.cameras import Camera
from lyceum_warp.core.fields import STATE_FIELDS, Field
from lyceum_warp.core.model_fields import ModelField


@dataclasses.dataclass(frozen=True)
class Space:
    """A world's vector with named parts, a dtype and optional bounds.

    An environment's arrays have a row for each world: their shape is (nworld, ``*shape``).
    """

    parts: Mapping[str, slice] = dataclasses.field(default_factory=dict)
    """Columns of each part, in order."""
    dtype: torch.dtype = torch.float32
    low: np.ndarray | None = None
    """Lower bounds, of shape ``shape``."""
    high: np.ndarray | None = None
    """Upper bounds, of shape ``shape``."""
    picture: tuple[int, int, int] | None = None
    """Height, width and channels of a camera's picture."""

    @classmethod
    def of(cls, sizes: Mapping[str, int], **rest: object) -> "Space":
        """Make a space from the sizes of its parts."""
        parts, start = {}, 0
        for name, size in sizes.items():
            parts[name] = slice(start, start + size)
            start += size
        return cls(parts, **rest)  # type: ignore[arg-type]

    @property
    def size(self) -> int:
        """Length of the vector, or 1 for a scalar."""
        return max((part.stop for part in self.parts.values()), default=1)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the vector, (size,), or () for a scalar; of a picture, (height, width, channels)."""
        return self.picture or ((self.size,) if self.parts else ())

    @property
    def columns(self) -> list[str]:
        """Names of the columns: the part's name, or ``name[i]`` if the part has several columns."""
        return [
            name if part.stop - part.start == 1 else f"{name}[{i}]"
            for name, part in self.parts.items()
            for i in range(part.stop - part.start)
        ]

    def part_at(self, column: int) -> str:
        """Get the name of the part at a column."""
        return next(name for name, part in self.parts.items() if part.start <= column < part.stop)

    def split(self, values: torch.Tensor) -> dict[str, torch.Tensor]:
        """Split values, (..., size), into views of the parts."""
        return {name: values[..., part] for name, part in self.parts.items()}


COUNTERS = ("step", "key", "episode", "done_reason")
"""Counters in a state: steps since the reset, key of the random stream, number of the episode, bits of ``Done``."""

OWN_PARTS = (*COUNTERS, "metrics", "success_steps")
"""Parts of a state that belong neither to MuJoCo nor to the task's memory."""


def action_space(
    model: mujoco.MjModel, action_range: tuple[float, float] | None, actions: Mapping[str, int] | None = None
) -> Space:
    """Make the space of actions, which are controls unless the task declares ``actions``.

    Bounds of controls are ``action_range`` or the model's control ranges.
    """
    if actions is not None:
        space = Space.of(actions)
        low, high = np.tile(np.array(action_range or (-np.inf, np.inf), dtype=np.float32), (space.size, 1)).T.copy()
        return dataclasses.replace(space, low=low, high=high)
    bounds = control_ranges(model) if action_range is None else np.tile(action_range, (model.nu, 1))
    low, high = np.ascontiguousarray(bounds.T, dtype=np.float32)
    return Space.of(_controls(model), low=low, high=high)


def _controls(model: mujoco.MjModel) -> dict[str, int]:
    """Map the name of each actuator to its number of controls."""
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nactuator)]
    sizes: dict[str, int] = {}
    for i in np.argsort(model.actuator_ctrladr, kind="stable").tolist():
        name = names[i] or f"actuator_{i}"
        while not names[i] and name in names:  # another actuator may have this name
            name = f"{name}_"
        if model.actuator_ctrlnum[i]:
            sizes[name] = int(model.actuator_ctrlnum[i])
    return sizes


_PIXELS: dict[str, tuple[int, torch.dtype, tuple[float, float]]] = {
    "rgb": (3, torch.uint8, (0, 255)), "depth": (1, torch.float32, (0, np.inf)),
    "segmentation": (2, torch.int32, (-1, 2**31 - 1)),
}  # fmt: skip
"""Channels, type and range of the pixels of each kind."""


def picture_space(camera: Camera) -> Space:
    """Make the space of a camera's pictures, of shape (height, width, channels)."""
    channels, dtype, bounds = _PIXELS[camera.kind]
    shape = camera.height, camera.width, channels
    low, high = (np.full(shape, bound, str(dtype).removeprefix("torch.")) for bound in bounds)
    return Space.of({camera.group: int(np.prod(shape))}, dtype=dtype, low=low, high=high, picture=shape)


def control_scale(model: mujoco.MjModel, action_range: tuple[float, float] | None) -> np.ndarray:
    """Compute the scale and the offset that turn an action into each control, (nu, 2)."""
    if action_range is None:
        return np.tile((1.0, 0.0), (model.nu, 1))
    ranges = control_ranges(model)
    if not np.isfinite(ranges).all():
        unlimited = np.flatnonzero(~np.isfinite(ranges).all(axis=1)).tolist()
        raise ValueError(
            f"action_range maps actions to the controls' ranges, but the controls {unlimited} have no range in the "
            "model: set the actuators' ctrlrange, or omit action_range"
        )
    low, high = action_range
    gain = (ranges[:, 1] - ranges[:, 0]) / (high - low)
    return np.stack([gain, ranges[:, 0] - gain * low], axis=1)


def control_ranges(model: mujoco.MjModel) -> np.ndarray:
    """Get the bounds of each control, (nu, 2), infinite if there are none."""
    return np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-np.inf, np.inf))


def state_space(
    model: mujoco.MjModel, snapshots: Iterable[Field], dynamics: Iterable[ModelField], parts: Mapping[str, int]
) -> Space:
    """Make the space of states: integration state in MuJoCo's order, snapshots, model fields, counters, other parts."""
    sizes = {}
    names = {component.value: name for name, component in STATE_FIELDS.items()}
    components = mujoco.mjtState.mjSTATE_INTEGRATION.value
    for component in (1 << bit for bit in range(components.bit_length())):
        if components & component and (size := mujoco.mj_stateSize(model, component)):
            fallback = mujoco.mjtState(component).name.removeprefix("mjSTATE_").lower()
            sizes[names.get(component, fallback)] = size
    sizes |= {field.name: field.size for field in snapshots} | {field.name: field.size for field in dynamics}
    return Space.of({**sizes, **dict.fromkeys(COUNTERS, 1), **parts}, dtype=torch.float64)
