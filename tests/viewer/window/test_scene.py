import mujoco
import numpy as np
import pytest
from headless_screen import robot

from lyceum_warp.viewer.protocol import BEST_COLOUR, Ghost, Pose
from lyceum_warp.viewer.window.scene import ExtraGeoms, ModelValues

MODEL = robot()
MOCAP = np.array([[1.0, 0, 1]]), np.array([[1.0, 0, 0, 0]])


def pose(x: float) -> Pose:
    qpos = MODEL.qpos0.copy()
    qpos[0] = x
    return Pose(qpos, *MOCAP)


def ghost(x: float, opacity: float = 0.3) -> Ghost:
    return Ghost(pose(x), (0.2, 0.4, 0.6, opacity))


def test_ghost_has_the_models_moving_geoms_in_its_colour() -> None:
    geoms = ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(2.0)]).geoms
    assert [geom.type for geom in geoms] == [int(mujoco.mjtGeom.mjGEOM_SPHERE)]  # the plane stands still
    np.testing.assert_allclose(geoms[0].pos, [2, 0, 1])
    np.testing.assert_allclose(geoms[0].rgba, [0.2, 0.4, 0.6, 0.3])
    assert geoms[0].transparent


def test_hidden_groups_have_no_ghosts() -> None:
    groups = np.zeros(6, np.uint8)
    assert ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(2.0)], groups=groups).geoms == []


def test_farthest_ghosts_are_dropped() -> None:
    drawn = ExtraGeoms(MODEL, 5).draw(pose(0), [ghost(9.0), ghost(1.0), ghost(-2.0)])
    assert drawn.ghosts == 2
    assert sorted(geom.pos[0] for geom in drawn.geoms if geom.pos[0] != 1 or geom.pos[2] != 1) == pytest.approx([-2.0])
    assert len(drawn.geoms) == 2


def test_a_ghost_leaves_out_geoms_that_lie_where_the_world_has_them() -> None:
    drawn = ExtraGeoms(MODEL, 100).draw(pose(0), [ghost(0.0), ghost(0.5)])
    assert drawn.ghosts == 2
    np.testing.assert_allclose([geom.pos[0] for geom in drawn.geoms], [0.5])


@pytest.mark.parametrize(
    ("kind", "angle", "drawn"),
    [("capsule", 1.0, 0), ("cylinder", 1.0, 0), ("sphere", 1.0, 0), ("box", 1.0, 1), ("box", 0.0, 0)],
)
def test_a_ghost_leaves_out_a_geom_that_only_turned_about_its_axis(kind: str, angle: float, drawn: int) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>
              <body><joint axis="0 0 1"/><geom type="{kind}" size=".1 .1 .1"/></body>
            </worldbody></mujoco>"""
    )
    none = np.empty((0, 3)), np.empty((0, 4))
    turned = Ghost(Pose(np.array([angle]), *none), (0.2, 0.4, 0.6, 0.3))
    assert len(ExtraGeoms(model, 100).draw(Pose(np.zeros(1), *none), [turned]).geoms) == drawn


def test_ghosts_of_a_model_with_several_bodies_are_drawn_in_their_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kinematics are computed once for each of them, and for the world itself."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='.1' pos='1 0 0'/><site pos='0 0 1'/>"
        "<body pos='1 0 0'><joint/><geom size='.1' pos='1 0 0'/></body></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    poses = [np.array(qpos, dtype=float) for qpos in ([0.3, 0.1], [1.5, 0.2], [-0.7, 2.0])]
    calls: list[int] = []
    kinematics = mujoco.mj_kinematics
    none = np.zeros((0, 3)), np.zeros((0, 4))
    geoms = ExtraGeoms(model, 100)
    with monkeypatch.context() as patch:
        patch.setattr(mujoco, "mj_kinematics", lambda *given: calls.append(1) or kinematics(*given))
        drawn = geoms.draw(Pose(np.zeros(2), *none), [Ghost(Pose(qpos, *none), (1, 0, 0, 0.3)) for qpos in poses])
    assert len(calls) == len(poses) + 1
    assert drawn.ghosts == 3
    expected = []
    for data.qpos[:] in poses:
        mujoco.mj_kinematics(model, data)
        expected += [*data.geom_xpos.tolist(), *data.site_xpos.tolist()]
    np.testing.assert_allclose(sorted(geom.pos.tolist() for geom in drawn.geoms), sorted(expected), atol=1e-6)


def test_traces_are_lines_between_their_points() -> None:
    traces = np.zeros((2, 4, 3))
    traces[..., 0] = np.arange(4)
    drawn = ExtraGeoms(MODEL, 100).draw(pose(0), traces=traces, best=1)
    assert drawn.traces == 2
    assert len(drawn.geoms) == 6
    assert all(geom.type == int(mujoco.mjtGeom.mjGEOM_LINE) for geom in drawn.geoms)
    np.testing.assert_allclose(drawn.geoms[0].rgba, BEST_COLOUR)
    np.testing.assert_allclose([geom.size[2] for geom in drawn.geoms], 1.0)


def test_too_many_traces_get_fewer_points_before_some_are_dropped() -> None:
    traces = np.random.default_rng(0).normal(size=(10, 33, 3))
    drawn = ExtraGeoms(MODEL, 100).draw(pose(0), traces=traces, best=0)
    assert drawn.traces == 10
    assert len(drawn.geoms) <= 100
    few = ExtraGeoms(MODEL, 50).draw(pose(0), traces=traces, best=0)
    assert 1 < few.traces < 10
    assert len(few.geoms) <= 50


def test_traces_leave_most_geoms_to_ghosts() -> None:
    traces = np.random.default_rng(0).normal(size=(100, 65, 3))
    assert len(ExtraGeoms(MODEL, 1024).draw(pose(0), traces=traces, best=0).geoms) <= 160


@pytest.mark.parametrize("limit", [1, 3, 10, 64])
@pytest.mark.parametrize("best", [None, 2])
def test_limit_is_never_exceeded(limit: int, best: int | None) -> None:
    traces = np.random.default_rng(0).normal(size=(7, 12, 3))
    drawn = ExtraGeoms(MODEL, limit).draw(pose(0), [ghost(i) for i in range(20)], traces, best)
    assert len(drawn.geoms) <= limit


@pytest.mark.parametrize("traces", [np.zeros((0, 5, 3)), np.zeros((3, 1, 3)), None])
def test_traces_without_lines_draw_nothing(traces: np.ndarray | None) -> None:
    assert ExtraGeoms(MODEL, 10).draw(pose(0), traces=traces).geoms == []


# the model of the world that is shown


def test_values_of_a_world_are_set_and_taken_back() -> None:
    values, gravity = ModelValues(MODEL), np.array([0.0, 0, -1])
    assert values.differ({"gravity": gravity})
    assert not values.set({"gravity": gravity})
    assert not values.differ({"gravity": gravity.copy()})
    np.testing.assert_array_equal(values.model.opt.gravity, gravity)
    assert values.differ({})
    values.set({})
    np.testing.assert_array_equal(values.model.opt.gravity, MODEL.opt.gravity)
    assert values.differences == []


@pytest.mark.parametrize(
    ("name", "seen"),
    [("geom_size", True), ("geom_rgba", True), ("body_pos", True), ("geom_friction", False), ("dof_damping", False)],
)
def test_only_fields_that_change_the_picture_are_seen(name: str, seen: bool) -> None:
    assert ModelValues(MODEL).set({name: np.array(getattr(MODEL, name)) + 0.1}) == seen


def test_constants_follow_the_values_and_elements_are_named() -> None:
    values = ModelValues(MODEL)
    values.set({"body_mass": np.array(MODEL.body_mass) * 2, "geom_rgba": np.array(MODEL.geom_rgba) / 2})
    assert values.model.body_subtreemass[0] == pytest.approx(2 * MODEL.body_subtreemass[0])
    assert [name for name, _ in values.differences] == [
        "body_mass ball", "body_mass goal", "geom_rgba 0", "geom_rgba ball", "geom_rgba goal",
    ]  # fmt: skip
