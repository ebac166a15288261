import mujoco
import numpy as np
import torch

from lyceum_warp.core import COUNTERS, Space
from lyceum_warp.core.fields import describe
from lyceum_warp.core.spaces import action_space, control_ranges, control_scale, state_space

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


def test_parts_of_a_space_are_consecutive_views_of_a_vector() -> None:
    space, values = Space.of({"position": 2, "velocity": 3}), torch.arange(10.0).view(2, 5)
    assert space.parts == {"position": slice(0, 2), "velocity": slice(2, 5)}
    assert (space.size, space.shape) == (5, (5,))
    space.split(values)["velocity"].zero_()
    assert values.tolist() == [[0.0, 1.0, 0.0, 0.0, 0.0], [5.0, 6.0, 0.0, 0.0, 0.0]]


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


def test_state_adds_snapshots_and_counters_and_memory_to_the_integration_state() -> None:
    compiled = model()
    space = state_space(compiled, [describe(compiled, "qacc")], [], {"memory": 4})
    assert space.dtype == torch.float64
    sizes = {name: part.stop - part.start for name, part in space.parts.items()}
    assert {name: sizes[name] for name in ("time", "qpos", "qvel", "ctrl", "mocap_pos", "userdata", "qacc")} == {
        "time": 1, "qpos": 2, "qvel": 2, "ctrl": 2, "mocap_pos": 3, "userdata": 2, "qacc": 2
    }  # fmt: skip
    assert list(space.parts)[-6:] == ["qacc", *COUNTERS, "memory"]
    integration = mujoco.mj_stateSize(compiled, mujoco.mjtState.mjSTATE_INTEGRATION.value)
    assert space.parts["qacc"].start == integration
    assert space.size == integration + 2 + len(COUNTERS) + 4
