"""Declare cameras whose pictures are observations."""

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

import mujoco
import numpy as np

from lyceum_warp.support.suggestions import did_you_mean, suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, check_kind, finite_number

Kind = Literal["rgb", "depth", "segmentation"]

_RULES: dict[str, Rule] = {
    **dict.fromkeys(("name", "group", "body"), "as Camera('fixed')"), "width": (1, 4096), "height": (1, 4096),
    "fovy": (1.0, 179.0),
}  # fmt: skip


@suggest_arguments
@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera whose pictures are a group of observations, ``env.obs_groups["camera"]``, (nworld, height, width, ...).

    The name is that of a camera of the model. With ``pos`` and ``lookat``, a camera with this name is added.

    Raises:
        ValueError: A value is of the wrong type or out of range.
    """

    name: str
    """Name of the camera."""
    width: int = 64
    """Columns of a picture, a multiple of 4."""
    height: int = 64
    """Rows of a picture."""
    kind: Kind = "rgb"
    """What a pixel holds. "rgb": red, green and blue, uint8. "depth": distance along the camera's axis in metres,
    float32; 0 if nothing is visible. "segmentation": id and type (mjtObj) of the object, int32; -1 if nothing is
    visible."""
    group: str = "camera"
    """Name of the group of observations. Several cameras need different groups."""
    pos: tuple[float, float, float] | None = None
    """Position of an added camera, in the frame of ``body``, in metres."""
    lookat: tuple[float, float, float] | None = None
    """A point at the picture's centre, in the frame of ``body``, in metres."""
    body: str = "world"
    """Body that carries an added camera."""
    fovy: float = 45.0
    """Vertical field of view of an added camera, in degrees."""

    def __post_init__(self) -> None:
        check_fields(self, _RULES)
        if self.width % 4:
            raise ValueError(f"width must be a multiple of 4, not {self.width}: use {self.width // 4 * 4 + 4}")
        if (self.pos is None) is not (self.lookat is None):
            raise ValueError(f"an added camera needs both pos and lookat, not pos={self.pos} and lookat={self.lookat}")
        for name in ("pos", "lookat") if self.pos is not None else ():
            point = tuple(finite_number(name, number) for number in getattr(self, name))
            if len(point) != 3:
                raise ValueError(f"{name} must have three coordinates, not {point}")
            object.__setattr__(self, name, point)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the camera to a model, if it is given by its pose."""
        if self.pos is None or self.lookat is None:
            return
        body = spec.worldbody if self.body == "world" else spec.body(self.body)
        if body is None:
            names = [body.name for body in spec.bodies]
            hint = did_you_mean(self.body, names, f"its bodies are {', '.join(filter(None, names))}")
            raise ValueError(f"the model has no body {self.body!r} for the camera {self.name!r}: {hint}")
        back = np.subtract(self.pos, self.lookat)
        if not (length := np.linalg.norm(back)):
            raise ValueError(f"pos and lookat of the camera {self.name!r} must differ, not both be {self.pos}")
        back /= length
        right = np.cross((0.0, 0.0, 1.0) if abs(back[2]) < 0.999 else (0.0, 1.0, 0.0), back)
        right /= np.linalg.norm(right)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).ravel())
        body.add_camera(name=self.name, pos=self.pos, quat=quat, fovy=self.fovy)


def cameras_of(entries: Any) -> tuple[Camera, ...]:
    """Convert cameras, their names, or dicts of their arguments to cameras with different groups.

    Raises:
        ValueError: An entry is none of these, or two cameras have the same group.
    """
    if not isinstance(entries, Iterable) or isinstance(entries, str):
        raise ValueError(f"cameras must be a list, as in cameras=[lw.Camera('fixed')], not {entries!r}")
    cameras: dict[str, Camera] = {}
    for entry in entries:
        camera = Camera(entry) if isinstance(entry, str) else Camera(**entry) if isinstance(entry, dict) else entry
        check_kind("a camera", camera, Camera, "as lw.Camera('fixed', width=64)")
        if camera.group in cameras:
            raise ValueError(
                f"two cameras have the group {camera.group!r}: name a camera once for each kind of picture, or give "
                "each one its own group=..."
            )
        cameras[camera.group] = camera
    return tuple(cameras.values())
