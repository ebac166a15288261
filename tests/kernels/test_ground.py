import mujoco
import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp.models.terrain import height_table

NROW, NCOL, SIZE = 6, 9, (2.0, 1.25, 0.8, 0.3)
OFFSET = (0.5, -0.25, 0.125)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The cells are rectangular, and the field is not at the origin."""
    spec = mujoco.MjSpec()
    heights = np.random.default_rng(0).uniform(size=NROW * NCOL)
    spec.add_hfield(name="field", size=SIZE, nrow=NROW, ncol=NCOL, userdata=heights)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", pos=OFFSET)
    return spec.compile()


@pytest.fixture(scope="module")
def ground(model: mujoco.MjModel) -> wp.array:
    return wp.array(height_table(model, "field"), dtype=float, device="cpu")


def ray_heights(model: mujoco.MjModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ground's heights (n,) and normals (n, 3) from MuJoCo's rays.

    The height is NaN if a ray hits nothing.
    """
    data, hit, normal = mujoco.MjData(model), np.zeros(1, np.int32), np.zeros(3)
    mujoco.mj_forward(model, data)
    heights, normals = np.full(len(points), np.nan), np.zeros((len(points), 3))
    for i, (x, y) in enumerate(points.astype(float)):
        start, down = np.array([x, y, 3.0]), np.array([0.0, 0.0, -1.0])
        distance = mujoco.mj_ray(model, data, start, down, None, 1, -1, hit, normal)
        if distance >= 0.0:
            heights[i], normals[i] = 3.0 - distance, normal
    return heights, normals


@wp.kernel
def look_up(ground: wp.array2d[float], points: wp.array[wp.vec2], out: wp.array2d[float]):
    i = wp.tid()
    x, y = points[i][0], points[i][1]
    out[i, 0] = lw.ground_height(ground, x, y)
    lw.put(out[i], 1, lw.ground_normal(ground, x, y))
    lw.put(out[i], 4, lw.on_ground(ground, x, y))
    out[i, 5] = lw.ground_distance(ground, wp.vec3(x, y, 2.0))


def looked_up(ground: wp.array, points: np.ndarray) -> np.ndarray:
    """Call the ground functions at n points.

    Return the height, normal, presence and distance of the ground, (n, 6). The distance is measured from points at a
    height of 2 m.
    """
    out = wp.zeros((len(points), 6), dtype=float, device="cpu")
    wp.launch(look_up, len(points), [ground, wp.array(points, dtype=wp.vec2, device="cpu"), out], device="cpu")
    found: np.ndarray = out.numpy()
    return found


def cells() -> tuple[np.ndarray, np.ndarray]:
    x = OFFSET[0] + np.linspace(-SIZE[0], SIZE[0], NCOL)
    y = OFFSET[1] + np.linspace(-SIZE[1], SIZE[1], NROW)
    corners = np.stack(np.meshgrid(x[:-1], y[:-1]), axis=-1).reshape(-1, 2)
    return corners, np.array([x[1] - x[0], y[1] - y[0]])


def test_heights_and_normals_in_both_triangles_of_each_cell_equal_those_of_mujoco_rays(
    model: mujoco.MjModel, ground: wp.array
) -> None:
    corners, sides = cells()
    rng = np.random.default_rng(1)
    upper = np.sort(rng.uniform(0.01, 0.99, (10, len(corners), 2)))  # above the diagonal: v > u
    lower = upper[..., ::-1]
    points = (corners + sides * np.concatenate([lower, upper])).reshape(-1, 2).astype(np.float32)
    heights, normals = ray_heights(model, points)
    found = looked_up(ground, points)
    np.testing.assert_allclose(found[:, 0], heights, atol=1e-6)
    np.testing.assert_allclose(found[:, 1:4], normals, atol=1e-5)
    np.testing.assert_allclose(found[:, 5], (2.0 - heights) * normals[:, 2], atol=1e-5)
    assert found[:, 4].all()


def test_heights_on_edges_and_diagonals_equal_those_of_mujoco_rays(model: mujoco.MjModel, ground: wp.array) -> None:
    corners, sides = cells()
    along = np.array([(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (0.25, 0.25), (1.0, 1.0)])
    points = (corners[:, None] + sides * along).reshape(-1, 2)
    # MuJoCo's rays miss the outer edge of the field
    inside = (abs(points - OFFSET[:2]) < np.array(SIZE[:2]) - 1e-9).all(axis=1)
    heights, _ = ray_heights(model, points[inside])
    assert len(heights) > 200 and np.isfinite(heights).all()
    np.testing.assert_allclose(looked_up(ground, points[inside])[:, 0], heights, atol=1e-6)
    # at the outer edge, the expected heights come from the model
    numbers = OFFSET[2] + SIZE[2] * model.hfield_data.reshape(NROW, NCOL)
    x = OFFSET[0] + np.linspace(-SIZE[0], SIZE[0], NCOL)
    top = np.stack([x, np.full(NCOL, OFFSET[1] + SIZE[1])], axis=1)
    np.testing.assert_allclose(looked_up(ground, top)[:, 0], numbers[-1], atol=1e-6)


def test_point_outside_the_field_has_the_height_of_the_nearest_edge_point(ground: wp.array) -> None:
    center, half = np.array(OFFSET[:2]), np.array(SIZE[:2])
    points = center + np.array([(3.0, 0.3), (-9.0, 0.3), (0.3, 2.0), (0.3, -1e6), (5.0, 5.0)])
    nearest = np.clip(points, center - half, center + half)
    found = looked_up(ground, points)
    np.testing.assert_array_equal(found[:, 0], looked_up(ground, nearest)[:, 0])
    assert not found[:, 4].any() and looked_up(ground, nearest)[:, 4].all()


@wp.kernel
def scan(
    ground: wp.array2d[float], points: wp.array[wp.vec2], base: wp.vec3, quat: wp.vec4, row: wp.array2d[float]
):  # fmt: skip
    lw.height_scan(row[0], ground, points, base, quat)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.6, -0.5)])
def test_scan_equals_rays_on_a_grid_that_turns_with_the_yaw(
    model: mujoco.MjModel, ground: wp.array, tilt: tuple[float, float]
) -> None:
    grid, base, yaw = lw.scan_grid(0.8, 0.4, spacing=0.2), np.array([0.6, -0.3, 1.4]), 0.7
    assert grid.shape == (15, 2) and np.allclose(grid[:4], [(-0.4, -0.2), (-0.4, 0.0), (-0.4, 0.2), (-0.2, -0.2)])
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array([yaw, *tilt]), "zyx")
    row = wp.zeros((1, 15), dtype=float, device="cpu")
    points = wp.array(grid, dtype=wp.vec2, device="cpu")
    wp.launch(scan, 1, [ground, points, wp.vec3(*base), wp.vec4(*quat), row], device="cpu")
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    heights, _ = ray_heights(model, base[:2] + grid @ turn.T)
    np.testing.assert_allclose(row.numpy()[0], base[2] - heights, atol=2e-6)


@wp.kernel
def levels(level: int, walked: float, commanded: float, rng: wp.array2d[wp.uint32], out: wp.array[int]):
    i = wp.tid()
    out[i] = lw.next_level(level, walked, commanded, 8.0, 5, rng[i])


def next_levels(level: int, walked: float, commanded: float) -> np.ndarray:
    """Return the next terrain levels for different random numbers. The terrain has five levels of 8 m patches."""
    rng = wp.array(np.arange(2000, dtype=np.uint32).reshape(-1, 1), dtype=wp.uint32, device="cpu")
    out = wp.zeros(len(rng), dtype=int, device="cpu")
    wp.launch(levels, len(rng), [level, walked, commanded, rng, out], device="cpu")
    found: np.ndarray = out.numpy()
    return found


@pytest.mark.parametrize(
    ("level", "walked", "commanded", "wanted"),
    [(2, 4.1, 10.0, 3), (2, 3.9, 10.0, 1), (2, 3.9, 7.0, 2), (0, 0.0, 10.0, 0), (2, 0.0, 0.0, 2), (3, 4.1, 0.0, 4)],
)
def test_terrain_level_changes_with_the_walked_distance(
    level: int, walked: float, commanded: float, wanted: int
) -> None:
    assert (next_levels(level, walked, commanded) == wanted).all()


def test_robot_that_completes_the_highest_level_gets_a_random_level() -> None:
    counts = np.bincount(next_levels(4, 4.1, 10.0), minlength=5)
    assert len(counts) == 5 and (abs(counts - 400) < 90).all()
