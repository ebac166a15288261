"""Make rough ground: a height field of patches of increasing difficulty, and the tables for its height scan."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.core.task import from_model
from lyceum_warp.support.suggestions import did_you_mean

Shape = Callable[[np.ndarray, np.ndarray, float, np.random.Generator], np.ndarray]
"""Function ``shape(x, y, amount, rng)`` that returns the heights of a square patch. ``x`` and ``y`` are the points'
coordinates relative to the patch's centre. Heights and coordinates are arrays (n, n) in m. Heights along the patch's
outline are then set to 0, so that patches meet without a step."""

_PLATFORM = 1.0
"""Half the side of the flat square at the centre of a patch, in m."""

_BASE = 1.0
"""Thickness of the ground below the lowest point, in m."""


def _inwards(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the distance of points from a patch's outline, in m. The distance is constant on the flat platform."""
    half = float(x.max())
    return np.clip(half - np.maximum(abs(x), abs(y)), 0.0, max(half - _PLATFORM, 0.0))


def _around_platform(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.maximum(abs(x), abs(y)) > _PLATFORM


def _flat(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    return np.zeros_like(x)


def _slope(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    return amount * _inwards(x, y)


def _stairs(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    tread = 0.3
    return amount * np.floor(_inwards(x, y) / tread + 1e-6)


def _steps(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    half, heights = float(x.max()), np.zeros_like(x)
    for _ in range(int(half * half) + 4):
        cx, cy = rng.uniform(-half, half, 2)
        wide, long = rng.uniform(0.25, 1.0, 2)
        heights[(abs(x - cx) <= wide) & (abs(y - cy) <= long)] = amount * rng.choice((-1.0, -0.5, 0.5, 1.0))
    return heights * _around_platform(x, y)


def _rough(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    side = x[0]
    knots = np.arange(side[0], side[-1] + 0.2, 0.2)
    values = rng.uniform(-amount, amount, (len(knots), len(knots)))
    for _ in range(2):  # along x, then along y
        values = np.array([np.interp(side, knots, row) for row in values]).T
    return values


def _waves(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    number = 2.0 * np.pi / x.max()  # two waves per patch
    heights: np.ndarray = amount * np.sin(number * x) * np.sin(number * y)
    return heights


def _stones(x: np.ndarray, y: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    pitch, depth, tiny = 0.8, 0.5, 1e-6
    into = [(side + tiny) % pitch for side in (x, y)]  # distance from a gap's near edge
    gap = np.logical_or(*[(phase > 2 * tiny) & (phase < amount) for phase in into])
    return np.where(gap & _around_platform(x, y), -depth, 0.0)


_KINDS: dict[str, tuple[Shape, float]] = {
    "flat": (_flat, 0.0),
    "slope_up": (_slope, -0.4), "slope_down": (_slope, 0.4),
    "stairs_up": (_stairs, -0.2), "stairs_down": (_stairs, 0.2),
    "steps": (_steps, 0.2), "rough": (_rough, 0.08), "waves": (_waves, 0.2), "stones": (_stones, 0.4),
}  # fmt: skip
"""Shapes of patches by name, each with its ``amount`` at difficulty 1."""


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Rough ground: a grid of square patches. Difficulty increases along y, and each column has one kind of patch.

    The difficulty of level i is (i + 1) / ``levels``. A patch depends only on the seed and on the patch's level and
    column. Patches have height 0 along their outline, and a flat border surrounds them.

    =================== ======================================================== ===================
    kind                ground around the middle of a patch                      at difficulty 1
    =================== ======================================================== ===================
    flat                flat
    slope_up, _down     a pyramid: the ground rises, or falls, from the middle   slope 0.4
    stairs_up, _down    the same in steps of 0.3 m                               0.2 m a step
    steps               rectangles, 0.5 to 2 m long, higher or lower             0.2 m
    rough               random heights every 0.2 m, with planes between          0.08 m up and down
    waves               two waves along each side                                0.2 m up and down
    stones              stones every 0.8 m, gaps 0.5 m deep                      gaps of 0.4 m
    =================== ======================================================== ===================
    """

    kinds: Mapping[str | Shape, int]
    """Number of columns for each kind of patch. A kind is a name from the table or a function ``shape(x, y, difficulty,
    rng)`` that returns heights, (n, n) in m. Its arguments x and y are the points' coordinates relative to the patch's
    centre, (n, n)."""
    levels: int = 10
    """Number of rows."""
    patch: float = 8.0
    """Side of a patch in m, a multiple of ``resolution``."""
    resolution: float = 0.1
    """Distance between points of the field, in m. A vertical wall becomes a slope of this width."""
    border: float = 4.0
    """Width of the border in m, a multiple of ``resolution``."""
    seed: int = 0
    """Seed of all random heights."""
    scale: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Sizes at difficulty 1, by kind. They replace the sizes in the table."""

    def __post_init__(self) -> None:
        for name in [*self.kinds, *self.scale]:
            if isinstance(name, str) and name not in _KINDS:
                hint = did_you_mean(name, _KINDS, f"use {', '.join(_KINDS)}, or a function")
                raise ValueError(f"there is no kind of terrain {name!r}: {hint}")
        for name, count in [("levels", self.levels), *((f"columns of {kind}", n) for kind, n in self.kinds.items())]:
            if not (isinstance(count, int) and count > 0):
                raise ValueError(f"{name} must be a whole number above 0, not {count!r}")
        if not self.kinds:
            raise ValueError('kinds must name at least one kind of patch, such as {"rough": 4}')
        if not self.resolution > 0.0:
            raise ValueError(f"resolution must be positive, not {self.resolution!r}")
        for name, length, least in (("patch", self.patch, 2), ("border", self.border, 0)):
            cells = length / self.resolution
            if not (cells >= least and abs(cells - round(cells)) < 1e-6):
                raise ValueError(f"{name}={length!r} must be a multiple of resolution={self.resolution!r}")

    @functools.cached_property
    def columns(self) -> tuple[str | Shape, ...]:
        """Return the kind of each column."""
        return tuple(kind for kind, count in self.kinds.items() for _ in range(count))

    @functools.cached_property
    def heights(self) -> np.ndarray:
        """Compute all heights, (points along y, points along x) in m."""
        cells, edge = self._cells, round(self.border / self.resolution)
        heights = np.zeros([count * cells + 1 + 2 * edge for count in (self.levels, len(self.columns))])
        for level in range(self.levels):
            for column in range(len(self.columns)):
                row, start = edge + level * cells, edge + column * cells
                # the outline stays 0
                inner = heights[row + 1 : row + cells, start + 1 : start + cells]
                inner[:] = self._patch(level, column)[1:-1, 1:-1]
        return heights

    @functools.cached_property
    def origins(self) -> np.ndarray:
        """Compute the patches' centres, relative to the plane that the field replaces, (levels, columns, 3) in m.

        The z coordinate is the greatest height within 0.5 m of the centre.
        """
        cells, edge, around = self._cells, round(self.border / self.resolution), round(0.5 / self.resolution)
        around = min(around, cells // 2)
        origins = np.zeros((self.levels, len(self.columns), 3))
        for level, column in np.ndindex(origins.shape[:2]):
            row = edge + level * cells + cells // 2
            start = edge + column * cells + cells // 2
            near = self.heights[row - around : row + around + 1, start - around : start + around + 1]
            origins[level, column] = (*self._corner + self.patch * (np.array([column, level]) + 0.5), near.max())
        return origins

    def add_to(self, spec: mujoco.MjSpec, *, name: str = "terrain") -> None:
        """Add the ground to a model in place of the world's plane.

        The height field gets the plane's name, friction and material. Without a plane, the model gets a geom called
        ``name``. One corner of a patch near the middle of the field is at the plane's position. All corners have height
        0, so a robot at a corner has the same height above the ground as before. The model's extent, on which cameras
        depend, does not change.

        Args:
            spec: The model, which is changed in place, for example in a task's ``edit_model``.
            name: Name of the height field.

        Raises:
            ValueError: The world has several planes, or a kind's function returns no heights.
        """
        planes = [geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
        if len(planes) > 1:
            named = ", ".join(repr(geom.name) for geom in planes)
            raise ValueError(f"the model has the planes {named}: delete all planes but one, which becomes the terrain")
        if np.isnan(spec.stat.extent):
            without = spec.copy().compile().stat
            spec.stat.extent, spec.stat.center = without.extent, without.center
        heights, (nrow, ncol) = self.heights, self.heights.shape
        size = self.resolution / 2.0 * np.array([ncol - 1, nrow - 1])
        low, depth = heights.min(), max(float(np.ptp(heights)), 1e-3)
        spec.add_hfield(name=name, size=[*size, depth, _BASE], nrow=nrow, ncol=ncol, userdata=heights.ravel())
        geom = planes[0] if planes else spec.worldbody.add_geom(name=name)
        geom.type, geom.hfieldname, geom.quat = mujoco.mjtGeom.mjGEOM_HFIELD, name, [1.0, 0.0, 0.0, 0.0]
        geom.pos = geom.pos + np.array([*self._corner - self.border + size, low])

    @property
    def _cells(self) -> int:
        return round(self.patch / self.resolution)

    @property
    def _corner(self) -> np.ndarray:
        return -self.patch * np.array([len(self.columns) // 2, self.levels // 2])

    def _patch(self, level: int, column: int) -> np.ndarray:
        kind, difficulty = self.columns[column], (level + 1) / self.levels
        side = self.resolution * (np.arange(self._cells + 1) - self._cells / 2)
        x, y = np.meshgrid(side, side)
        rng = np.random.default_rng((self.seed, level, column))
        if isinstance(kind, str):
            shape, amount = _KINDS[kind]
            return shape(x, y, difficulty * float(np.copysign(self.scale.get(kind, amount), amount)), rng)
        heights = np.asarray(kind(x, y, difficulty, rng), dtype=float)
        if heights.shape != x.shape or not np.isfinite(heights).all():
            raise ValueError(f"{kind!r} must return finite heights of shape {x.shape}, not {heights!r}")
        return heights


def height_table(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Make the table of a model's height field, (1 + points along y, 1 + points along x) in m; see ``height_field``.

    Raises:
        ValueError: The model has no such height field. Exactly one geom must use the height field, and this geom must
            be fixed and upright.
    """
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_HFIELD, name)
    if number < 0:
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_HFIELD, i) for i in range(model.nhfield)]
        raise ValueError(f"the model has no height field {name!r}; it has: {', '.join(names) or 'none'}")
    (geoms,) = np.nonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD) & (model.geom_dataid == number))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    fixed = (model.body_weldid[model.geom_bodyid[geoms]] == 0).all()
    if len(geoms) != 1 or not fixed or not np.allclose(data.geom_xmat[geoms[0]], np.eye(3).ravel(), atol=1e-9):
        raise ValueError(
            f"exactly one geom must use the height field {name!r}, and this geom must be fixed and upright: "
            f"{len(geoms)} geoms use the height field"
        )
    position, (along_x, along_y, height, _) = data.geom_xpos[geoms[0]], model.hfield_size[number]
    nrow, ncol = int(model.hfield_nrow[number]), int(model.hfield_ncol[number])
    start = model.hfield_adr[number]
    table = np.zeros((1 + nrow, 1 + ncol))
    table[0, 1:] = position[0] + np.linspace(-along_x, along_x, ncol)
    table[1:, 0] = position[1] + np.linspace(-along_y, along_y, nrow)
    heights = model.hfield_data[start : start + nrow * ncol].reshape(nrow, ncol)
    table[1:, 1:] = position[2] + height * heights.astype(float)
    return table


def height_field(name: str) -> Any:
    """Return a default for ``Params``: a table with the heights of a height field.

    Pass the table to ``lw.ground_height`` and ``lw.height_scan``. It has the shape (1 + points along y, 1 + points
    along x). The first row has the points' x coordinates, and the first column has their y coordinates. All other
    elements are heights. The coordinates are in the world's frame, in m. For example: ``ground: wp.array2d[float] =
    lw.height_field("terrain")``.

    Args:
        name: Name of the height field in the model. ``lw.Terrain.add_to`` calls it "terrain" by default.
    """
    return from_model(lambda model, _: height_table(model, name))


def scan_grid(length: float, width: float, *, spacing: float = 0.1) -> np.ndarray:
    """Return a grid of points around a robot, (n, 2) in m, for ``lw.height_scan``.

    The first point is at the rear right. Points are ordered by x (forwards), then by y (to the left).
    ``lw.scan_grid(1.6, 1.0)`` has 17 x 11 points. For example: ``scan: wp.array[wp.vec2] = lw.scan_grid(1.6, 1.0)``.

    Args:
        length: Extent along x, forwards, in m.
        width: Extent along y, in m.
        spacing: Distance between neighbouring points, in m.
    """
    x = np.linspace(-length / 2, length / 2, round(length / spacing) + 1)
    y = np.linspace(-width / 2, width / 2, round(width / spacing) + 1)
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
