from typing import Any

import mujoco
import numpy as np
import pytest
from headless_screen import frame_of, robot, state_of

from lyceum_warp.viewer.protocol import Frame, Ghost
from lyceum_warp.viewer.window.scene import ExtraGeoms, ModelValues

MODEL = robot()
SHOWN, HIDDEN = np.ones(6, np.uint8), np.zeros(6, np.uint8)


def frame(**changes: Any) -> Frame:
    return frame_of(MODEL, mujoco.MjData(MODEL), **changes)


def ghost(x: float) -> Ghost:
    data = mujoco.MjData(MODEL)
    data.qpos[0] = x
    return Ghost(state_of(MODEL, data), (0.2, 0.4, 0.6, 0.3))


def test_ghost_draws_the_moving_geoms_of_visible_groups_in_its_colour() -> None:
    geoms = ExtraGeoms(MODEL, 100).of(frame(ghosts=(ghost(2.0),)), SHOWN)
    assert [geom.type for geom in geoms] == [int(mujoco.mjtGeom.mjGEOM_SPHERE)]  # no static plane
    np.testing.assert_allclose(geoms[0].pos, [2, 0, 1])
    np.testing.assert_allclose(geoms[0].rgba, [0.2, 0.4, 0.6, 0.3])
    assert geoms[0].transparent
    assert ExtraGeoms(MODEL, 100).of(frame(ghosts=(ghost(2.0),)), HIDDEN) == []


def test_ghost_of_a_mesh_is_an_ellipsoid_because_a_browser_draws_no_additional_meshes() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco>
      <asset><mesh name="wedge" vertex="0 0 0  2 0 0  0 1 0  0 0 4"/></asset>
      <worldbody><body pos="0 0 3"><joint type="slide"/><geom type="mesh" mesh="wedge"/></body></worldbody>
    </mujoco>""")
    state = state_of(model, mujoco.MjData(model))
    shown = frame_of(model, mujoco.MjData(model), ghosts=(Ghost(state, None, (5.0, 0.0)),))
    (geom,) = ExtraGeoms(model, 100).of(shown, SHOWN)
    assert geom.type == mujoco.mjtGeom.mjGEOM_ELLIPSOID and geom.dataid == -1
    corners = geom.mat @ np.diag(geom.size) / 0.98
    low, high = geom.pos - np.abs(corners).sum(1), geom.pos + np.abs(corners).sum(1)
    np.testing.assert_array_less(low, np.array([5.001, 0.001, 3.001]))
    np.testing.assert_array_less(np.array([6.999, 0.999, 6.999]), high)


def test_ghosts_that_coincide_with_the_displayed_world_are_omitted() -> None:
    geoms = ExtraGeoms(MODEL, 100).of(frame(ghosts=(ghost(0.0), ghost(0.5))), SHOWN)
    np.testing.assert_allclose([geom.pos[0] for geom in geoms], [0.5])


def test_traces_have_few_lines_and_leave_room_for_ghosts() -> None:
    traces = np.random.default_rng(0).normal(size=(25, 100, 3))
    scene = ExtraGeoms(MODEL, 200)
    geoms = scene.of(frame(traces=traces), SHOWN)
    assert len(geoms) == 160
    np.testing.assert_allclose(geoms[0].pos, traces[0, 0])
    assert len(scene.of(frame(traces=traces[:1, :9]), SHOWN)) == 8
    ghosts = tuple(ghost(i) for i in range(1, 60))
    assert 160 < len(scene.of(frame(ghosts=ghosts, traces=traces), SHOWN)) <= 200


# model values


@pytest.mark.parametrize(
    ("name", "seen"),
    [("geom_size", True), ("body_pos", True), ("gravity", False), ("density", False), ("dof_damping", False)],
)
def test_changed_and_visible_model_values_are_reported(name: str, seen: bool) -> None:
    def value_in(model: Any) -> np.ndarray:
        return np.ravel(getattr(model if hasattr(model, name) else model.opt, name)).astype(np.float32)

    values, nominal = ModelValues(MODEL), value_in(MODEL)
    assert values.set({name: nominal * (1 + 1e-9)}) == (False, False)  # rounded
    for value in (nominal + 0.1, nominal):
        assert values.set({name: value}) == (True, seen)
        assert values.set({name: value.copy()}) == (False, False)
        np.testing.assert_array_equal(value_in(values.model), value)


def test_derived_constants_are_updated_with_the_model_values() -> None:
    values = ModelValues(MODEL)
    values.set({"body_mass": 2 * np.array(MODEL.body_mass)})
    assert values.model.body_subtreemass[0] == pytest.approx(2 * MODEL.body_subtreemass[0])
