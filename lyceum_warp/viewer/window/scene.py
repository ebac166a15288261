"""Draw what studio's scene lacks: ghosts and traces, the model of one world, and the choice of the camera."""

import copy
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Ghost, Pose
from lyceum_warp.viewer.window.studio import ux

LINE_WIDTH = 3.0  # pixels
MAX_LINES = 160
"""Lines of all traces. A browser is sent all geoms 60 times a second, with about 600 bytes for each."""
FEWEST_SEGMENTS = 4
"""Segments of a trace where there are too few geoms for all its points."""
SEEN = (
    "geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_matid", "geom_dataid", "geom_group", "site_", "body_pos",
    "body_quat", "jnt_pos", "jnt_axis", "qpos0", "mat_", "tendon_rgba", "tendon_width", "cam_", "light_", "hfield_",
    "mesh_", "skin_", "flex_",
)  # fmt: skip
"""What the names of fields begin with that change the picture."""

LISTED = 8
"""Elements of a field that are listed."""


# ghosts and traces


@dataclasses.dataclass
class Drawn:
    """What the ghosts and traces of a frame became."""

    geoms: list[mujoco.MjvGeom]
    ghosts: int
    """Ghosts that are drawn."""
    traces: int
    """Traces that are drawn."""


class ExtraGeoms:
    """Draws ghosts and traces with a limited number of geoms.

    The best trace comes first, then the ghosts, then the other traces. Of too many ghosts, those farthest from the
    world that is shown are left out; of too many traces, those that end farthest from the best one.

    Args:
        model: The model whose geoms a ghost has.
        limit: Geoms that may be drawn.

    """

    def __init__(self, model: mujoco.MjModel, limit: int) -> None:
        self.model, self.limit = model, limit
        self._data = mujoco.MjData(model)
        self._options = mujoco.MjvOption()
        self._perturb = mujoco.MjvPerturb()
        # a ghost that does not fit is noticed after its geoms were added
        self._scene = mujoco.MjvScene(model, limit + 2 * (model.ngeom + model.nsite) + 10)
        self._lines = [mujoco.MjvGeom() for _ in range(limit)]

    def draw(
        self,
        pose: Pose,
        ghosts: Sequence[Ghost] = (),
        traces: np.ndarray | None = None,
        best: int | None = None,
        groups: np.ndarray | None = None,
    ) -> Drawn:
        """Make the geoms of a frame; they are valid until the next call.

        Args:
            pose: The pose of the world that is shown.
            ghosts: Poses beside it.
            traces: (samples, points, 3), metres.
            best: Index of the best of them.
            groups: (6,) which groups of geoms are visible; those of a new ``MjvOption`` otherwise.

        """
        if groups is not None:
            self._options.geomgroup = groups
        paths = [np.asarray(path, dtype=np.float64) for path in ([] if traces is None else traces)]
        ends = np.array([path[-1] for path in paths]).reshape(-1, 3)
        distances = (
            np.linalg.norm(ends - (ends.mean(0) if best is None else ends[best]), axis=1) if paths else np.empty(0)
        )
        if best is not None:
            distances[best] = -1.0
        order = np.argsort(distances, kind="stable")
        chosen = [(paths[i], BEST_COLOUR if i == best else TRACE_COLOUR) for i in order]

        first = self._trace(chosen[:1], min(self.limit, MAX_LINES), 0) if best is not None else 0
        bodies, drawn = self._ghosts(pose, ghosts, self.limit - first)
        rest = chosen[1:] if first else chosen
        before = first
        left = min(self.limit - len(bodies), MAX_LINES) - first
        segments = max(len(paths[0]) - 1, 1) if paths else 1
        if rest and len(rest) * segments > left:
            segments = min(max(left // len(rest), FEWEST_SEGMENTS), segments)
            rest = rest[: max(left, 0) // segments]
        for path, colour in rest:
            before += self._trace([(path, colour)], segments, before)
        return Drawn([*bodies, *self._lines[:before]], drawn, len(rest) + bool(first))

    def _trace(self, paths: Sequence[tuple[np.ndarray, Sequence[float]]], segments: int, begin: int) -> int:
        """Draw paths from the line ``begin`` on, with at most ``segments`` lines each; return how many they take."""
        used = 0
        for path, colour in paths:
            number = min(len(path) - 1, segments)
            points = path[np.linspace(0, len(path) - 1, number + 1).round().astype(int)]
            for start, end in itertools.pairwise(points):
                line = self._lines[begin + used]
                mujoco.mjv_initGeom(
                    line, mujoco.mjtGeom.mjGEOM_LINE, _ZERO, _ZERO, _UNIT, np.array(colour, dtype=np.float32)
                )
                line.emission = 1.0  # visible in the dark, too
                mujoco.mjv_connector(line, mujoco.mjtGeom.mjGEOM_LINE, LINE_WIDTH, start, end)
                used += 1
        return used

    def _ghosts(self, pose: Pose, ghosts: Sequence[Ghost], limit: int) -> tuple[list[mujoco.MjvGeom], int]:
        """Draw the nearest ghosts that fit; return their geoms and their number."""
        if not ghosts or limit <= 0:
            return [], 0
        here = self._place(pose)
        placed = [self._place(ghost.pose) for ghost in ghosts]
        distances = [np.linalg.norm(each.centre - here.centre) for each in placed]
        scene, drawn = self._scene, 0
        scene.ngeom = 0
        ends: list[tuple[int, int]] = []
        for i in np.argsort(distances, kind="stable"):
            begin = scene.ngeom
            placed[i].write(self._data)
            mujoco.mjv_addGeoms(
                self.model, self._data, self._options, self._perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene
            )
            if scene.ngeom > limit:
                scene.ngeom = begin
                break
            ends.append((scene.ngeom, i))
            drawn += 1
        geoms: list[mujoco.MjvGeom] = []
        begin = 0
        for end, i in ends:
            colour, same = ghosts[i].colour, placed[i].geoms_as_in(here, self.model.geom_type)
            for geom in scene.geoms[begin:end]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and same[geom.objid]:
                    continue  # two surfaces in one place flicker
                geom.rgba = colour
                geom.matid = -1  # the colour instead of the material's
                geom.transparent = colour[3] < 1
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # not taken for the body itself
                geoms.append(geom)
            begin = end
        return geoms, drawn

    def _place(self, pose: Pose) -> "_Placed":
        """Where the geoms lie at a pose."""
        data = self._data
        data.qpos[:] = pose.qpos
        if self.model.nmocap:
            data.mocap_pos[:], data.mocap_quat[:] = pose.mocap_pos, pose.mocap_quat
        mujoco.mj_kinematics(self.model, data)
        masses = self.model.body_mass
        centre = masses @ data.xipos / max(masses.sum(), mujoco.mjMINVAL)
        return _Placed(centre, tuple(getattr(data, name).copy() for name in _PLACES))


_PLACES = ("xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat")
"""What the kinematics compute and a drawing uses."""
_ROUND = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
"""Geoms that look the same at any angle about their third axis."""


@dataclasses.dataclass
class _Placed:
    """A pose whose kinematics were computed."""

    centre: np.ndarray
    """(3,) centre of mass, metres."""
    places: tuple[np.ndarray, ...]

    def geoms_as_in(self, other: "_Placed", types: np.ndarray) -> np.ndarray:
        """Which geoms look as in another pose, within a millimetre and half a degree, (ngeom,).

        Capsules and cylinders may turn about their axes, and spheres about all.
        """
        places = dict(zip(_PLACES, self.places, strict=True))
        others = dict(zip(_PLACES, other.places, strict=True))
        near = np.abs(places["geom_xpos"] - others["geom_xpos"]).max(1, initial=0.0) < 1e-3
        turned = np.abs(places["geom_xmat"] - others["geom_xmat"]).reshape(-1, 3, 3)
        turned[np.isin(types, _ROUND), :, :2] = 0.0  # columns are axes
        turned[types == mujoco.mjtGeom.mjGEOM_SPHERE] = 0.0
        return near & (turned.max((1, 2), initial=0.0) < 1e-2)

    def write(self, data: mujoco.MjData) -> None:
        for name, value in zip(_PLACES, self.places, strict=True):
            getattr(data, name)[:] = value


_ZERO, _UNIT = np.zeros(3), np.eye(3).ravel()


# the model of the world that is shown


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


# cameras


class ViewCameras:
    """Chooses the camera of the view.

    Args:
        viewer: Studio's viewer, whose camera is set. Its model may come later.
        values: The model that is shown, which has the cameras.

    """

    def __init__(self, viewer: Any, values: ModelValues) -> None:
        self.viewer, self.values = viewer, values
        self.state = ux.UxState()
        """What studio keeps of the choice."""

    def choose(self, index: int) -> None:
        """Choose studio's free, flying or tracking camera, or a camera of the model."""
        self.state.camera_index = ux.set_camera(self.values.model, self.viewer.camera, index)

    def change(self, by: int) -> None:
        """Go to the next camera, or to one before."""
        indices = self.indices()
        self.choose(indices[(indices.index(self.state.camera_index) + by) % len(indices)])

    def indices(self) -> list[int]:
        """The cameras that can be chosen, in the order of the panel."""
        return [ux.TUMBLE_CAMERA_IDX, ux.FREE_CAMERA_IDX, ux.TRACKING_CAMERA_IDX, *range(self.values.model.ncam)]

    def name(self, index: int) -> str:
        """What the panel calls a camera."""
        fixed = {ux.TUMBLE_CAMERA_IDX: "free", ux.FREE_CAMERA_IDX: "flying", ux.TRACKING_CAMERA_IDX: "tracking"}
        return fixed.get(index) or self.values.model.camera(index).name or f"camera {index}"

    def reset(self) -> None:
        """Look at the whole model; follow the body that a camera of the model follows."""
        model, camera = self.values.model, self.viewer.camera
        mujoco.mjv_defaultFreeCamera(model, camera)
        self.state.camera_index = ux.TUMBLE_CAMERA_IDX
        tracking = (int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK), int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
        for mode, body in zip(model.cam_mode, model.cam_bodyid, strict=True):
            if int(mode) in tracking:
                self.track(int(body))
                camera.elevation = -20
                camera.distance = 3 * self.size_of(int(body))
                return

    def size_of(self, body: int) -> float:
        """The size of a body with all that is attached to its root, metres."""
        model, data = self.values.model, mujoco.MjData(self.values.model)
        mujoco.mj_kinematics(model, data)
        moving = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
        if not moving.any():
            return float(model.stat.extent)
        sizes = model.geom_rbound[moving, None]
        low, high = (data.geom_xpos[moving] - sizes).min(0), (data.geom_xpos[moving] + sizes).max(0)
        return float(np.linalg.norm(high - low))

    def track(self, body: int) -> None:
        """Follow a body."""
        self.choose(ux.TRACKING_CAMERA_IDX)
        self.viewer.camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
        self.viewer.camera.trackbodyid = body
        self.viewer.camera.fixedcamid = -1

    def view(self) -> protocol.Camera:
        """The camera of the view."""
        camera = self.viewer.camera
        x, y, z = (float(value) for value in camera.lookat)
        return protocol.Camera(
            lookat=(x, y, z),
            distance=float(camera.distance),
            azimuth=float(camera.azimuth),
            elevation=float(camera.elevation),
            tracked_body=int(camera.trackbodyid) if camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING else -1,
            fixed=int(camera.fixedcamid) if camera.type == mujoco.mjtCamera.mjCAMERA_FIXED else -1,
        )
