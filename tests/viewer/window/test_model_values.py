import numpy as np
import pytest
from headless_screen import robot

from lyceum_warp.viewer.window.scene import ModelValues


def test_values_of_a_world_are_set_and_taken_back() -> None:
    values = ModelValues(robot())
    gravity = np.array([0.0, 0, -1])
    assert values.differ({"gravity": gravity})
    assert not values.set({"gravity": gravity})
    assert not values.differ({"gravity": gravity.copy()})
    np.testing.assert_array_equal(values.model.opt.gravity, gravity)
    assert values.differ({})
    values.set({})
    np.testing.assert_array_equal(values.model.opt.gravity, robot().opt.gravity)
    assert values.differences == []


@pytest.mark.parametrize(
    ("name", "seen"),
    [("geom_size", True), ("geom_rgba", True), ("body_pos", True), ("geom_friction", False), ("dof_damping", False)],
)  # fmt: skip
def test_only_fields_that_change_the_picture_are_seen(name: str, seen: bool) -> None:
    model = robot()
    assert ModelValues(model).set({name: np.array(getattr(model, name)) + 0.1}) == seen


def test_constants_follow_the_values() -> None:
    model = robot()
    values = ModelValues(model)
    values.set({"body_mass": np.array(model.body_mass) * 2})
    assert values.model.body_subtreemass[0] == pytest.approx(2 * model.body_subtreemass[0])


def test_many_elements_are_cut_short() -> None:
    model = robot()
    values = ModelValues(model)
    values.set({"geom_solref": np.array(model.geom_solref) * 2, "geom_rgba": np.array(model.geom_rgba) / 2})
    lines = values.differences
    assert [name for name, _ in lines] == [
        "geom_solref 0", "geom_solref ball", "geom_solref goal", "geom_rgba 0", "geom_rgba ball", "geom_rgba goal",
    ]  # fmt: skip
