"""Find the camera of a video: a camera of the model by name or index, or a free camera by its pose."""

import dataclasses
import textwrap
from typing import Any, TypeAlias

import mujoco
import numpy as np

from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import finite_number, positive_number


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeCamera:
    """A camera that looks at a point or follows a body. The defaults are those of MuJoCo's free camera."""

    lookat: tuple[float, float, float] | None = None
    """The point to look at, in metres. A camera that follows a body looks at the centre of mass of the body's
    subtree."""
    distance: float | None = None
    """The distance from the point ``lookat``, in metres."""
    azimuth: float | None = None
    """The direction of the view around the vertical axis, in degrees. 0 looks along x, and 90 along y."""
    elevation: float | None = None
    """The direction of the view above the horizontal plane, in degrees. -90 looks straight down."""
    track: str | int | None = None
    """The name or the index of a body to follow."""


CameraChoice: TypeAlias = str | int | FreeCamera | mujoco.MjvCamera | None
"""A camera of the model by name or index, a free camera ("free" for MuJoCo's default), or None for a video's default.

The default is the model's first tracking camera. If the model has no tracking camera, the default is its first camera
that is fixed to the world. If it has no such camera either, a new camera follows the first body.
"""

FREE = "free"


def find_camera(model: mujoco.MjModel, camera: CameraChoice = None) -> mujoco.MjvCamera:
    """Return the chosen camera as an ``MjvCamera``.

    Raises:
        ValueError: The model has no such camera or body, or a number is not valid.
    """
    if isinstance(camera, mujoco.MjvCamera):
        return camera
    if camera is None:
        return _default_camera(model)
    if isinstance(camera, FreeCamera):
        return _free_camera(model, camera)
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_CAMERA, i) or "" for i in range(model.ncam)]
    if (index := _index(names, camera)) is not None:
        return _fixed_camera(index)
    if camera == FREE:
        return _free_camera(model, FreeCamera())
    raise ValueError(f"there is no camera {camera!r}: {_listed(names)}, or {FREE!r}, MuJoCo's default free camera")


def camera_values(model: mujoco.MjModel, camera: CameraChoice = None) -> dict[str, Any]:
    """Return the attributes of the chosen camera's ``MjvCamera``, which can be pickled."""
    view = find_camera(model, camera)
    names = ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "orthographic")
    return {"lookat": view.lookat.tolist()} | {name: getattr(view, name) for name in names}


def _default_camera(model: mujoco.MjModel) -> mujoco.MjvCamera:
    tracking = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
    for cameras in (np.isin(model.cam_mode, tracking), model.cam_bodyid == 0):
        if cameras.any():
            return _fixed_camera(int(cameras.argmax()))
    return _free_camera(model, FreeCamera(track=1 if model.nbody > 1 else None))


def _fixed_camera(index: int) -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, index
    return view


def _free_camera(model: mujoco.MjModel, camera: FreeCamera) -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, view)
    if camera.lookat is not None:
        point = np.asarray(camera.lookat, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ValueError(f"the camera's lookat must be three finite numbers, not {camera.lookat}")
        view.lookat[:] = point
    if camera.distance is not None:
        view.distance = positive_number("the camera's distance", camera.distance, "metres")
    for name in ("azimuth", "elevation"):
        if (angle := getattr(camera, name)) is not None:
            setattr(view, name, finite_number(f"the camera's {name} in degrees", angle))
    if camera.track is not None:
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, _body(model, camera.track)
    return view


def _body(model: mujoco.MjModel, body: str | int) -> int:
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) or "" for i in range(model.nbody)]
    if (index := _index(names, body)) is not None:
        return index
    bodies = ", ".join(filter(None, names))
    hint = did_you_mean(str(body), names, f"its bodies are {textwrap.shorten(bodies, 200)}")
    raise ValueError(f"the camera cannot track the body {body!r}, which the model does not have: {hint}")


def _index(names: list[str], choice: object) -> int | None:
    """Find the index of a name, or check an index."""
    if isinstance(choice, str):
        if choice and choice in names:
            return names.index(choice)
        choice = int(choice) if choice.isdecimal() else None
    is_number = isinstance(choice, int | np.integer) and not isinstance(choice, bool)
    return int(choice) if is_number and 0 <= choice < len(names) else None  # type: ignore[operator, call-overload]


def _listed(names: list[str]) -> str:
    if not names:
        return "the model has none"
    cameras = ", ".join(f"{name!r} ({i})" if name else str(i) for i, name in enumerate(names))
    return f"the model has {cameras}"
