import mujoco
import numpy as np

from lyceum_warp.core.spaces import action_space, control_ranges, control_scale

XML = """
<mujoco>
  <size nuserdata="2"/>
  <worldbody>
    <body mocap="true"><geom size=".1"/></body>
    <body><joint name="a"/><joint name="b" axis="1 0 0"/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <motor name="push" joint="a" ctrlrange="-2 4" ctrllimited="true"/>
    <motor joint="b" {}/>
  </actuator>
</mujoco>
"""
LIMITED = 'ctrlrange="0 1" ctrllimited="true"'


def model(second: str = LIMITED) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(second))


def test_actions_have_the_names_and_ranges_of_the_actuators() -> None:
    space = action_space(model(), None)
    assert list(space.parts) == ["push", "actuator_1"]
    assert space.low is not None and space.high is not None
    assert (space.low.tolist(), space.high.tolist()) == ([-2.0, 0.0], [4.0, 1.0])
    assert space.low.dtype == np.float32


MANY = """
<mujoco>
  <worldbody>
    <site name="here"/>
    <body><joint name="a" type="ball"/><geom size=".1"/><site name="tip"/></body>
    <body><joint name="b"/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <motor name="actuator_2" joint="b"/>
    <orientation name="aim" site="tip" refsite="here" kp="1"/>
    <motor joint="b"/>
  </actuator>
</mujoco>
"""


def test_actuator_has_an_action_per_control_and_a_unique_name() -> None:
    space = action_space(mujoco.MjModel.from_xml_string(MANY), None)
    assert space.parts == {"actuator_2": slice(0, 1), "aim": slice(1, 4), "actuator_2_": slice(4, 5)}
    assert space.low is not None
    assert space.low.shape == space.shape == (5,)


def test_action_range_replaces_the_control_ranges() -> None:
    for action_range, low, high in ((None, [-2.0, -np.inf], [4.0, np.inf]), ((-1.0, 1.0), [-1.0, -1.0], [1.0, 1.0])):
        space = action_space(model(""), action_range)
        np.testing.assert_array_equal([space.low, space.high], [low, high])


def test_control_scale_maps_the_action_range_to_the_control_range() -> None:
    ranges, scale = control_ranges(model()), control_scale(model(), (-1.0, 3.0))
    for action, bound in ((-1.0, ranges[:, 0]), (3.0, ranges[:, 1])):
        np.testing.assert_allclose(scale[:, 0] * action + scale[:, 1], bound)


def test_actions_of_a_task_have_bounds_only_with_an_action_range() -> None:
    space = action_space(model(), (-2.0, 2.0), {"speed": 1, "turn": 2})
    assert space.parts == {"speed": slice(0, 1), "turn": slice(1, 3)}
    np.testing.assert_array_equal([space.low, space.high], [[-2.0] * 3, [2.0] * 3])
    free = action_space(model(), None, {"speed": 1})
    np.testing.assert_array_equal([free.low, free.high], [[-np.inf], [np.inf]])
