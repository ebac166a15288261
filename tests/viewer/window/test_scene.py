import mujoco
import numpy as np
import pytest
from headless_screen import robot

from lyceum_warp.viewer.protocol import Ghost, Pose
from lyceum_warp.viewer.window.scene import ExtraGeoms, ModelValues

MODEL = robot()
MOCAP = np.array([[1.0, 0, 1]]), np.array([[1.0, 0, 0, 0]])


def pose(x: float) -> Pose:
    qpos = MODEL.qpos0.copy()
    qpos[0] = x
    return Pose(qpos, *MOCAP)


def ghost(x: float, opacity: float = 0.3) -> Ghost:
    return Ghost(pose(x), (0.2, 0.4, 0.6, opacity))


def test_transparent_copy_draws_the_moving_geoms_in_its_own_colour() -> None:
    geoms = ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(2.0)])
    assert [geom.type for geom in geoms] == [int(mujoco.mjtGeom.mjGEOM_SPHERE)]  # no static plane
    np.testing.assert_allclose(geoms[0].pos, [2, 0, 1])
    np.testing.assert_allclose(geoms[0].rgba, [0.2, 0.4, 0.6, 0.3])
    assert geoms[0].transparent


def test_hidden_geom_groups_have_no_transparent_copies() -> None:
    groups = np.zeros(6, np.uint8)
    assert ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(2.0)], groups=groups) == []


def test_copies_that_coincide_with_the_world_in_view_are_omitted() -> None:
    geoms = ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(0.0), ghost(0.5)])
    np.testing.assert_allclose([geom.pos[0] for geom in geoms], [0.5])


@pytest.mark.parametrize(("limit", "number"), [(1024, 10), (100, 10), (10, 10), (1024, 100), (3, 7), (1, 7)])
@pytest.mark.parametrize("best", [None, 2])
def test_traces_are_thinned_before_some_are_omitted(limit: int, number: int, best: int | None) -> None:
    traces = np.random.default_rng(0).normal(size=(number, 33, 3))
    scene = ExtraGeoms(MODEL, limit)
    geoms = scene.draw(pose(0), traces=traces, best=best)
    assert len(geoms) <= min(limit, 160)
    assert (len(geoms) >= 4 * number) == (limit >= 100 and number == 10)  # a trace has at least 4 lines
    assert len(scene.draw(pose(0), [ghost(i) for i in range(20)], traces, best)) <= limit


# model values


def test_model_values_of_a_world_are_set_and_reset() -> None:
    values, gravity = ModelValues(MODEL), np.array([0.0, 0, -1])
    assert values.set({"gravity": gravity}) == (True, False)
    assert values.set({"gravity": gravity.copy()}) == (False, False)
    np.testing.assert_array_equal(values.model.opt.gravity, gravity)
    assert values.set({}) == (True, False)
    np.testing.assert_array_equal(values.model.opt.gravity, MODEL.opt.gravity)


@pytest.mark.parametrize(
    ("name", "seen"),
    [("geom_size", True), ("geom_rgba", True), ("body_pos", True), ("geom_friction", False), ("dof_damping", False)],
)
def test_only_visible_model_fields_change_the_picture(name: str, seen: bool) -> None:
    assert ModelValues(MODEL).set({name: np.array(getattr(MODEL, name)) + 0.1}) == (True, seen)


def test_derived_constants_are_updated_with_the_model_values() -> None:
    values = ModelValues(MODEL)
    values.set({"body_mass": np.array(MODEL.body_mass) * 2})
    assert values.model.body_subtreemass[0] == pytest.approx(2 * MODEL.body_subtreemass[0])
