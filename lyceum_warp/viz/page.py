"""Write an episode as one HTML file: a scene that can be played and turned in any browser, without a server or network.

The file holds the triangles of the visible geoms in body coordinates, and the bodies' poses in each frame. The script
in ``page.html`` draws them with WebGL. The floor's squares are the only texture.
"""

import base64
import html
import json
import tempfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.files import replace_text
from lyceum_warp.viz.cameras import CameraChoice, camera_values
from lyceum_warp.viz.video import check_states

_GROUPS = 3  # MuJoCo shows the first three groups of geoms by default
_AROUND, _ALONG = 24, 12  # segments of a circle and of a half circle
_RATE = 60  # maximum frames per second
_FLOOR = 200.0  # half the side of an infinite floor, in m
Surface = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices and normals, both (n, 3), and triangles, (m, 3)."""


def write_page(env: Env, states: torch.Tensor, out: str | Path, *, camera: CameraChoice = None) -> Path:
    """Write a self-contained page that plays states in a browser.

    Args:
        env: The environment of the states.
        states: The states of one world, one row per step, (steps, state_space.size).
        out: The file. An existing file is replaced when the page is complete.
        camera: The initial camera, as in ``write_video``. The user can turn the view.

    Raises:
        ValueError: The states do not have the environment's shape, or the model has no such camera.
    """
    check_states(env, states)
    stride = max(1, round(1 / (_RATE * env.timestep)))
    rows = states[::stride, : env.engine.integration_size].double().cpu().numpy()
    view = camera_values(env.model, camera)
    return write_states(env.model, rows, out, dt=stride * env.timestep, title=env.task.name, camera=view)


class ShownPage:
    """A page of ``write_page`` as the output of a notebook's cell, in any browser and without a server.

    Args:
        content: The page's HTML.
        height: The height of the output, in pixels.
    """

    def __init__(self, content: str, height: int) -> None:
        self.content, self.height = content, height

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.content)}" style="{style}" loading="lazy"></iframe>'


def show(env: Env, states: torch.Tensor, *, camera: CameraChoice = None, height: int = 360) -> ShownPage:
    """Show states of one world in a notebook. Drag the robot to turn the view.

    ``lw.view`` shows running worlds instead, but only while the notebook's kernel runs.

    Args:
        env: The environment of the states.
        states: The states of one world, one row per step, (steps, state_space.size), such as a trajectory's.
        camera: The initial camera, as in ``write_video``.
        height: The height of the output, in pixels.

    Returns:
        The output of the cell.

    Raises:
        ValueError: The states do not have the environment's shape, or the model has no such camera.
    """
    with tempfile.TemporaryDirectory() as folder:
        return ShownPage(write_page(env, states, Path(folder, "page.html"), camera=camera).read_text(), height)


def write_states(
    model: mujoco.MjModel, states: Iterable[np.ndarray], out: str | Path, *, dt: float, title: str,
    camera: dict[str, Any],
) -> Path:  # fmt: skip
    """Write integration states (``mjSTATE_INTEGRATION``) of a model as a page; see ``write_page``."""
    data, frames = mujoco.MjData(model), []
    for state in states:
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(model, data)
        frames.append(np.concatenate([data.xpos, data.xquat], axis=1))
    vertices, indices, ranges = _triangles(model)
    tracked = camera["trackbodyid"]
    if (fixed := camera["fixedcamid"]) >= 0:  # a camera of the model has no point to look at
        tracked = int(model.cam_bodyid[fixed])
        camera = {"lookat": model.stat.center.tolist(), "distance": 1.5 * model.stat.extent}
        camera |= {"azimuth": 120.0, "elevation": -20.0}
    moving = np.flatnonzero(model.body_dofnum)
    content = {
        "dt": dt, "ranges": ranges, "fovy": float(model.vis.global_.fovy), "reach": 30 * float(model.stat.extent),
        "followed": tracked if tracked > 0 else int(moving[0]) if len(moving) else 0,
        "camera": {name: camera[name] for name in ("lookat", "distance", "azimuth", "elevation")},
        "poses": _packed(np.array(frames, dtype=np.float32)), "vertices": _packed(vertices),
        "indices": _packed(indices),
    }  # fmt: skip
    text = Path(__file__).with_name("page.html").read_text().replace("TITLE", html.escape(title), 1)
    replace_text(Path(out), text.replace("DATA", json.dumps(content), 1))
    return Path(out)


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), 9)).decode()


def _triangles(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Return the triangles of the visible geoms.

    Returns:
        The vertices, the vertex indices of the triangles, and a range of indices (first, count) for each body.
    """
    kind = np.dtype([("at", np.float32, 3), ("normal", np.int8, 4), ("colour", np.uint8, 4)])
    vertices: list[np.ndarray] = []
    indices: list[np.ndarray] = []
    ranges, count, used = [], 0, 0
    for body in range(model.nbody):
        first = used
        for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group < _GROUPS)).tolist():
            rgba = _colour(model, geom)
            surface = _surface(model, geom)
            if surface is None or rgba[3] == 0:
                continue
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                rgba[3] = 0.0  # marks a floor
            points, normals, faces = surface
            axes = np.empty(9)
            mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
            rows = np.empty(len(points), dtype=kind)
            rows["at"] = points @ axes.reshape(3, 3).T + model.geom_pos[geom]
            rows["normal"][:, :3] = np.round(127 * normals @ axes.reshape(3, 3).T)
            rows["normal"][:, 3], rows["colour"] = 0, np.round(255 * rgba)
            vertices.append(rows)
            indices.append(faces.ravel().astype(np.uint32) + count)
            count, used = count + len(points), used + faces.size
        ranges.append((first, used - first))
    return np.concatenate([*vertices, np.empty(0, kind)]), np.concatenate([*indices, np.empty(0, np.uint32)]), ranges


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return a geom's colour, or its material's colour."""
    colour, material = model.geom_rgba[geom].astype(float), model.geom_matid[geom]
    if material < 0 or not np.allclose(colour, (0.5, 0.5, 0.5, 1.0)):
        return colour
    return np.array(model.mat_rgba[material], dtype=float)


def _surface(model: mujoco.MjModel, geom: int) -> Surface | None:
    """Make a geom's surface in the geom's coordinates. Some kinds of geoms are omitted."""
    types = mujoco.mjtGeom
    kind, size = types(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == types.mjGEOM_PLANE:
        x, y = np.where(size[:2] > 0, size[:2], _FLOOR) if model.geom_bodyid[geom] else (_FLOOR, _FLOOR)
        corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0.0]])
        return corners, np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]])
    if kind == types.mjGEOM_BOX:
        return _flat(*_box(size))
    if kind in (types.mjGEOM_SPHERE, types.mjGEOM_ELLIPSOID, types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER):
        return _round(kind, size)
    if kind == types.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        points = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        return _flat(points, model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]])
    if kind == types.mjGEOM_HFIELD:
        return _flat(*_ground(model, model.geom_dataid[geom]))
    return None


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


def _ground(model: mujoco.MjModel, field: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = model.hfield_nrow[field], model.hfield_ncol[field]
    x, y, top, _ = model.hfield_size[field]
    heights = model.hfield_data[model.hfield_adr[field] :][: rows * columns].reshape(rows, columns)
    across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    return np.stack([across, along, top * heights], -1).reshape(-1, 3), faces


def _flat(points: np.ndarray, faces: np.ndarray) -> Surface:
    """Make a surface from triangles. Triangles that meet at less than 30 degrees share normals, to look smooth."""
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    mean = np.zeros_like(points, dtype=float)
    for corner in range(3):
        np.add.at(mean, faces[:, corner], normals)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)
    flat = np.repeat(normals / area, 3, axis=0)
    shared = mean[faces.ravel()]
    smooth = (flat * shared).sum(1, keepdims=True) > np.cos(np.radians(30))
    return corners.reshape(-1, 3), np.where(smooth, shared, flat), np.arange(faces.size).reshape(-1, 3)


def _round(kind: mujoco.mjtGeom, size: np.ndarray) -> Surface:
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_CYLINDER:  # one cap, the side, the other cap
        height, radius = np.array([-1, -1, -1, 1, 1, 1.0]), np.array([0, 1, 1, 1, 1, 0.0])
        rise, out = np.array([-1, -1, 0, 0, 1, 1.0]), np.array([0, 0, 1, 1, 0, 0.0])
        place = np.stack([radius * size[0], height * size[1]])
    else:
        angle = np.linspace(-np.pi / 2, np.pi / 2, _ALONG + 1)
        if kind == types.mjGEOM_CAPSULE:  # the capsule has two middle rings
            angle = np.concatenate([np.linspace(-np.pi / 2, 0, _ALONG // 2), np.linspace(0, np.pi / 2, _ALONG // 2)])
        out, rise = np.cos(angle), np.sin(angle)
        lift = np.sign(np.arange(len(angle)) - len(angle) / 2 + 0.5) * size[1] if kind == types.mjGEOM_CAPSULE else 0.0
        place = np.stack([out * size[0], rise * size[0] + lift])
    around = np.linspace(0, 2 * np.pi, _AROUND + 1)
    circle = np.stack([np.cos(around), np.sin(around)], 1)
    points = np.concatenate([np.column_stack([r * circle, np.full(len(circle), z)]) for r, z in place.T])
    normals = np.concatenate(
        [np.column_stack([r * circle, np.full(len(circle), z)]) for r, z in zip(out, rise, strict=True)]
    )
    if kind == types.mjGEOM_ELLIPSOID:
        points = normals * size
        normals = normals / size
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ring, step = np.meshgrid(np.arange(len(out) - 1), np.arange(_AROUND), indexing="ij")
    a = (ring * (_AROUND + 1) + step).ravel()
    b, c, d = a + 1, a + _AROUND + 2, a + _AROUND + 1
    return points, normals, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
