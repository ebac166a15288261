"""Show ghosts and traces, set the values of one world in the model, and choose the camera."""

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Arrow, Frame
from lyceum_warp.viewer.window.studio import ux
from lyceum_warp.viz import change_model, owner_of

LINE_WIDTH = 3.0  # pixels
SHRUNK = 0.98
ARROW_WIDTH, SHORTEST_ARROW = 0.015, 0.01  # m
BEST_LINES, TRACE_LINES = 40, 5
"""Maximum number of lines in the best trace, and in each other trace. Each line costs about 600 bytes, 60 times a
second."""
VISIBLE = (
    "geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_matid", "geom_dataid", "geom_group", "site_", "body_pos",
    "body_quat", "jnt_pos", "jnt_axis", "qpos0", "mat_", "tendon_rgba", "tendon_width", "cam_", "light_", "hfield_",
    "mesh_", "skin_", "flex_",
)  # fmt: skip
"""Prefixes of the model fields that change how the model looks."""


# ghosts and traces


class ExtraGeoms:
    """Makes the geoms of ghosts and traces. Ghosts beyond a limit are left out."""

    def __init__(self, model: mujoco.MjModel, limit: int) -> None:
        self.model, self.limit = model, limit
        self._data = mujoco.MjData(model)
        self._options, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        # `_ghosts` adds a ghost before it counts the geoms, so the scene needs room beyond the limit
        self._scene = mujoco.MjvScene(model, limit + 2 * (model.ngeom + model.nsite) + 10)

    def of(self, frame: Frame, groups: np.ndarray) -> list[mujoco.MjvGeom]:
        """Make the geoms of a frame. The geoms are valid until the next frame.

        Args:
            frame: The frame.
            groups: Whether each group of geoms is visible, (6,).
        """
        self._options.geomgroup = groups
        lines = _arrows(frame.arrows)
        for i, path in enumerate(() if frame.traces is None else frame.traces):
            lines += _lines(path, TRACE_COLOUR, TRACE_LINES) if i else _lines(path, BEST_COLOUR, BEST_LINES)
        return [*self._ghosts(frame, self.limit - len(lines)), *lines]

    def _ghosts(self, frame: Frame, limit: int) -> list[mujoco.MjvGeom]:
        data, scene, geoms = self._data, self._scene, []
        self._place(frame.state)
        positions, axes = data.geom_xpos.copy(), data.geom_xmat.copy()
        scene.ngeom = 0
        for ghost in frame.ghosts:
            self._place(ghost.state)
            begin = scene.ngeom
            mujoco.mjv_addGeoms(self.model, data, self._options, self._perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
            if scene.ngeom > limit:
                break
            colour, beside = ghost.colour, ghost.shift != (0.0, 0.0)
            near, turned = np.abs(data.geom_xpos - positions), np.abs(data.geom_xmat - axes)
            same = (near.max(1, initial=0.0) < 1e-3) & (turned.max(1, initial=0.0) < 1e-2)
            for geom in scene.geoms[begin : scene.ngeom]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and same[geom.objid] and not beside:
                    continue  # surfaces that coincide would flicker
                if geom.dataid >= 0:  # studio draws no additional meshes
                    geom.type, geom.dataid = mujoco.mjtGeom.mjGEOM_ELLIPSOID, -1
                    geom.size = self.model.geom_aabb[geom.objid, 3:]
                    geom.pos += geom.mat @ self.model.geom_aabb[geom.objid, :3]
                geom.size *= SHRUNK  # surfaces may still coincide, such as those of a capsule that turned on its axis
                geom.pos[:2] += ghost.shift
                if colour is not None:
                    geom.rgba = colour
                    geom.matid = -1  # no material
                    geom.transparent = colour[3] < 1
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # cannot be selected
                geoms.append(geom)
        return geoms

    def _place(self, state: np.ndarray) -> None:
        mujoco.mj_setState(self.model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(self.model, self._data)


def _lines(path: np.ndarray, colour: Sequence[float], most: int) -> list[mujoco.MjvGeom]:
    """Make the lines of a path, with fewer points if there would be more than ``most`` lines."""
    last = len(path) - 1
    points = path[np.linspace(0, last, min(last, most) + 1).round().astype(int)]
    lines = []
    for start, end in itertools.pairwise(points):
        line = _connector(mujoco.mjtGeom.mjGEOM_LINE, colour, LINE_WIDTH, start, end)
        line.emission = 1.0  # make the lines visible without light
        lines.append(line)
    return lines


def _arrows(arrows: Sequence[Arrow]) -> list[mujoco.MjvGeom]:
    return [
        _connector(mujoco.mjtGeom.mjGEOM_ARROW, arrow.colour, ARROW_WIDTH, arrow.start, arrow.end)
        for arrow in arrows
        if np.linalg.norm(arrow.end - arrow.start) > SHORTEST_ARROW
    ]


def _connector(
    kind: mujoco.mjtGeom, colour: Sequence[float], width: float, start: np.ndarray, end: np.ndarray
) -> mujoco.MjvGeom:
    geom, rgba = mujoco.MjvGeom(), np.array(colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
    mujoco.mjv_connector(geom, kind, width, start, end)
    return geom


# the model with the values of the displayed world


class ModelValues:
    """Holds a copy of the model with the values of one world."""

    def __init__(self, nominal: mujoco.MjModel) -> None:
        self._values: dict[str, np.ndarray] = {}
        self.model = copy.deepcopy(nominal)

    def set(self, values: dict[str, np.ndarray]) -> tuple[bool, bool]:
        """Set a world's values. Return whether any value has changed, and whether the change is visible."""
        model = self.model
        changed = [name for name, value in values.items() if not _equal(value, getattr(owner_of(model, name), name))]
        if changed:
            self._values = values
            self.copy_to(self.model)
        return bool(changed), any(name.startswith(VISIBLE) for name in changed)

    def copy_to(self, model: mujoco.MjModel) -> None:
        """Set the values in another copy of the model, and recompute its constants."""
        change_model(mujoco, model, self._values)


def _equal(first: np.ndarray, second: Any) -> bool:
    """Compare in single precision, because MuJoCo Warp rounds the model's values."""
    return np.array_equal(first.astype(np.float32), np.ravel(second).astype(np.float32))


# cameras


class ViewCameras:
    """Chooses the camera of the view."""

    def __init__(self, viewer: Any, values: ModelValues) -> None:
        self.viewer, self.values = viewer, values
        self.state = ux.UxState()
        self._fit = 1.0  # how much farther the camera is than in a page that is wider than high

    def choose(self, index: int) -> None:
        """Choose studio's free, flying or tracking camera, or a camera of the model."""
        self.state.camera_index = ux.set_camera(self.values.model, self.viewer.camera, index)

    def reset(self) -> None:
        """Look at the whole model. If a camera of the model tracks a body, track this body."""
        model = self.values.model
        mujoco.mjv_defaultFreeCamera(model, self.viewer.camera)
        self.state.camera_index = ux.TUMBLE_CAMERA_IDX
        modes = (mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
        tracking = np.isin(model.cam_mode, [int(mode) for mode in modes])
        if tracking.any():
            self.choose(ux.TRACKING_CAMERA_IDX)
            camera = self.viewer.camera
            camera.type, camera.fixedcamid = int(mujoco.mjtCamera.mjCAMERA_TRACKING), -1
            camera.trackbodyid, camera.elevation = int(model.cam_bodyid[tracking.argmax()]), -20
        self.viewer.camera.distance *= self._fit

    def fit(self, aspect: float) -> None:
        """Move the camera so that a scene of this height, in multiples of its width, shows all of the robot."""
        before, self._fit = self._fit, max(aspect, 1.0)
        self.viewer.camera.distance *= self._fit / before

    def view(self) -> dict[str, Any]:
        """The attributes of the camera."""
        camera, names = self.viewer.camera, ("type", "trackbodyid", "fixedcamid", "distance", "azimuth", "elevation")
        return {"lookat": camera.lookat.tolist()} | {name: getattr(camera, name) for name in names}
