import mujoco
import numpy as np
import pytest

import lyceum_warp as lw
from lyceum_warp.models.terrain import height_table

KINDS = ("flat", "slope_up", "slope_down", "stairs_up", "stairs_down", "steps", "rough", "waves", "stones")

# the description


def patch(kind: str, *, level: int = 0, levels: int = 1, **options: object) -> np.ndarray:
    """Make the heights of an 8 m patch, with a point every 0.1 m."""
    terrain = lw.Terrain({kind: 1}, levels=levels, border=0.0, **options)
    return terrain.heights[80 * level : 80 * level + 81]


def row_of(kind: str, **options: object) -> np.ndarray:
    return patch(kind, **options)[40, 40:]


def test_slopes_and_stairs_are_pyramids_with_a_flat_top() -> None:
    away = 0.1 * np.arange(41)
    np.testing.assert_allclose(row_of("slope_down"), 0.4 * np.minimum(3.0, 4.0 - away), atol=1e-9)
    np.testing.assert_allclose(row_of("slope_up"), -row_of("slope_down"))
    np.testing.assert_allclose(row_of("stairs_down"), -row_of("stairs_up"))
    steps = np.diff(row_of("stairs_up", scale={"stairs_up": 0.15}))
    np.testing.assert_allclose(steps[steps != 0.0], 0.15)
    assert (np.diff(np.flatnonzero(steps)) == 3).all() and np.count_nonzero(steps) == 10  # treads of 0.3 m
    for kind in ("slope_up", "stairs_down"):
        np.testing.assert_array_equal(patch(kind), patch(kind).T)


@pytest.mark.parametrize(("width", "cells"), [(0.4, 4), (0.3, 3), (0.25, 3)])
def test_stones_have_gaps_of_the_given_width(width: float, cells: int) -> None:
    heights = patch("stones", scale={"stones": width})
    assert set(np.unique(heights)) == {-0.5, 0.0}
    for row in (heights[40, 51:-1], heights[1:30, 40]):  # beyond the platform
        tops = np.flatnonzero(row == 0.0)
        gaps = np.diff(tops)[np.diff(tops) > 1]
        assert len(gaps) >= 3 and (gaps == cells).all()
    assert not patch("stones", scale={"stones": 0.1}).any()  # the gap is too narrow to contain a point


@pytest.mark.parametrize(("kind", "amount"), [("steps", 0.2), ("rough", 0.08), ("waves", 0.2)])
def test_patches_with_steps_waves_or_rough_ground_reach_their_full_height_and_depth(kind: str, amount: float) -> None:
    heights = patch(kind)
    assert -amount <= heights.min() < -0.9 * amount and 0.9 * amount < heights.max() <= amount


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "flat"])
def test_patches_are_harder_at_higher_levels_and_flat_at_their_edges(kind: str) -> None:
    sizes = [abs(patch(kind, level=level, levels=4)).sum() for level in range(4)]
    assert (np.diff(sizes) > 0.0).all() and (sizes[0] > 0.0 or kind == "stones")
    heights = patch(kind)
    assert not heights[[0, -1]].any() and not heights[:, [0, -1]].any()


def test_equal_seeds_give_equal_fields_and_a_new_column_does_not_change_others() -> None:
    field = lw.Terrain({"rough": 1, "steps": 1}, levels=2, seed=3).heights
    np.testing.assert_array_equal(lw.Terrain({"rough": 1, "steps": 1}, levels=2, seed=3).heights, field)
    assert (lw.Terrain({"rough": 1, "steps": 1}, levels=2, seed=4).heights != field).any()
    more = lw.Terrain({"rough": 1, "steps": 1, "flat": 2}, levels=3, seed=3, scale={"rough": 0.12, "steps": 0.3})
    # another level and a height factor of 1.5 do not change the first two levels
    np.testing.assert_allclose(more.heights[40:200, 40:200], field[40:200, 40:200], atol=1e-12)


def test_a_custom_function_makes_patches() -> None:
    def ridge(x: np.ndarray, y: np.ndarray, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        return difficulty * (abs(x) < 0.25)

    terrain = lw.Terrain({"flat": 1, ridge: 2}, levels=2, patch=2.0, border=1.0)
    assert terrain.columns == ("flat", ridge, ridge)
    assert terrain.heights.shape == (61, 81) and terrain.heights[20, 40] == 0.5 and terrain.heights[40, 60] == 1.0
    np.testing.assert_allclose(terrain.origins[:, 1:, 2], [[0.5, 0.5], [1.0, 1.0]])
    wrong = lw.Terrain({lambda x, y, difficulty, rng: x[0]: 1})
    with pytest.raises(ValueError, match=r"must return finite heights of shape \(81, 81\)"):
        wrong.add_to(mujoco.MjSpec())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kinds": {"stair_up": 1}}, "no kind of terrain 'stair_up': did you mean stairs_up"),
        ({"kinds": {}}, "at least one kind"),
        ({"kinds": {"rough": 0}}, "columns of rough must be a whole number above 0, not 0"),
        ({"levels": 2.5}, "levels must be a whole number above 0, not 2.5"),
        ({"patch": 8.05}, r"patch=8\.05 must be a multiple of resolution=0\.1"),
        ({"border": -1.0}, r"border=-1\.0 must be a multiple"),
        ({"resolution": 0.0}, r"resolution must be positive, not 0\.0"),
        ({"scale": {"ruogh": 0.1}}, "no kind of terrain 'ruogh': did you mean rough"),
    ],
)
def test_invalid_terrain_raises_an_error(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lw.Terrain(**{"kinds": {"rough": 1}, **arguments})


# in a model


def model_of(terrain: lw.Terrain, spec: mujoco.MjSpec | None = None) -> mujoco.MjModel:
    spec = mujoco.MjSpec() if spec is None else spec
    terrain.add_to(spec)
    return spec.compile()


def test_compiled_model_has_the_heights_and_origins_of_the_terrain() -> None:
    terrain = lw.Terrain({"stairs_up": 2, "rough": 1}, levels=2, patch=3.0, border=0.5)
    model = model_of(terrain)
    table = height_table(model, "terrain")
    np.testing.assert_allclose(table[1:, 1:], terrain.heights, atol=1e-6)
    data, hit = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, data)
    for x, y, z in terrain.origins[:, :2].reshape(-1, 3):
        start, down = np.array([x + 1e-4, y, 9.0]), np.array([0.0, 0.0, -1.0])
        assert abs(9.0 - mujoco.mj_ray(model, data, start, down, None, 1, -1, hit) - z) < 1e-6
    assert np.ptp(terrain.origins[0, :, 0]) == pytest.approx(6.0) and terrain.origins[1, 0, 1] == pytest.approx(1.5)


def test_terrain_replaces_the_plane_and_has_its_name_and_friction() -> None:
    spec = mujoco.MjSpec()
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[1, 1, 1], friction=[0.3, 0.01, 0.001], pos=[1, 2, 0.5])
    model = model_of(lw.Terrain({"slope_up": 1}, levels=1), spec)
    assert model.ngeom == 1 and model.geom("floor").type == mujoco.mjtGeom.mjGEOM_HFIELD
    np.testing.assert_allclose(model.geom("floor").friction, [0.3, 0.01, 0.001])
    table = height_table(model, "terrain")
    assert table[1:, 1:].max() == pytest.approx(0.5) and table[1:, 1:].min() == pytest.approx(0.5 - 1.2)
    assert (table[0, 1:].min(), table[1:, 0].max()) == pytest.approx((1 - 4, 2 + 12))
    spec.worldbody.add_geom(name="one", type=plane, size=[1, 1, 1])
    spec.worldbody.add_geom(name="two", type=plane, size=[1, 1, 1])
    with pytest.raises(ValueError, match="the planes 'one', 'two': delete all planes but one"):
        lw.Terrain({"flat": 1}).add_to(spec)


def test_height_table_of_a_missing_or_moving_field_raises_an_error() -> None:
    model = model_of(lw.Terrain({"flat": 1}, levels=1))
    with pytest.raises(ValueError, match="no height field 'floor'; it has: terrain"):
        height_table(model, "floor")
    spec = mujoco.MjSpec()
    spec.add_hfield(name="plate", size=[1, 1, 1, 1], nrow=2, ncol=2, userdata=[0, 1, 0, 1])
    body = spec.worldbody.add_body(mass=1, inertia=[1, 1, 1])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="plate", mass=0)
    with pytest.raises(ValueError, match="exactly one geom must use the height field 'plate'"):
        height_table(spec.compile(), "plate")
