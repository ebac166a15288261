"""The values of a task's parameters: defaults, checks, and what the kernels read."""

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp.binding.parameters import Parameters
from lyceum_warp.options import OPTIONS

XML = """
<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder"/><geom size=".1"/>
      <body name="lower"><joint name="elbow"/><geom size=".1"/><site name="tip"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@wp.struct
class Params:
    dt: float
    gain: float = 1.0
    count: int = 3
    lively: bool = False
    offset: wp.vec3 = wp.vec3(0.0, 0.0, 0.5)
    tip: int = lw.site("tip")
    elbow: int = lw.dof("elbow")


@wp.struct
class Demanding:
    dt: float
    mass: float


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def parameters(model: mujoco.MjModel, struct: Any = Params, nworld: int = 2, **given: Any) -> Parameters:
    return Parameters(struct, "arm", model, nworld=nworld, timestep=0.02, given=given)


def test_defaults_come_from_the_struct_and_dt_from_the_timestep(model: mujoco.MjModel) -> None:
    values = parameters(model).values
    assert {name: values[name] for name in ("dt", "gain", "count", "lively")} == {
        "dt": 0.02, "gain": 1.0, "count": 3, "lively": False
    }  # fmt: skip
    assert list(values["offset"]) == [0.0, 0.0, 0.5]


def test_named_elements_become_their_places_in_the_model(model: mujoco.MjModel) -> None:
    values = parameters(model).values
    assert (values["tip"], values["elbow"]) == (0, 1)
    for elbow in ("shoulder", lw.dof("shoulder"), 0):
        assert parameters(model, elbow=elbow).values["elbow"] == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gian": 2.0}, "the task 'arm' has no parameter 'gian': did you mean gain"),
        ({"dt": 0.1}, "the task 'arm' has no parameter 'dt'"),
        ({"num_envs": 4}, "no parameter 'num_envs': did you mean nworld"),
        ({"gain": "much"}, "the parameter gain='much' of 'arm' is not a number"),
        ({"gain": np.nan}, "the parameter gain=nan of 'arm' is not a number"),
        ({"gain": [1.0, 2.0, 3.0]}, r"gain of 'arm' has shape \(3,\); it takes one number, or one a world, \(2,\)"),
        ({"offset": 1.0}, r"offset of 'arm' has shape \(\); it takes \(3,\), or one a world, \(2, 3\)"),
        ({"count": 2.5}, "count=2.5 of 'arm' must be a whole number"),
        ({"lively": 0.5}, "lively=0.5 of 'arm' must be a whole number"),
        ({"tip": 1}, "tip=1 of 'arm' is an index of 'site_xpos', of which the model has 1: give one from 0 to 0"),
        ({"tip": -1}, "tip=-1 of 'arm' is an index of 'site_xpos', of which the model has 1"),
        ({"tip": [0, 1]}, r"tip=\[0, 1\] of 'arm' is an index of 'site_xpos', of which the model has 1"),
        ({"tip": "top"}, "no site 'top' for the field 'site_xpos'; it has: tip"),
        ({"tip": lw.body("lower")}, "tip of 'arm' can't be an element of 'xpos': it is one of 'site_xpos'"),
        ({"gain": lw.body("lower")}, "gain of 'arm' can't be an element of 'xpos': it is a number"),
    ],
)
def test_a_value_that_does_not_fit_is_refused(given: dict[str, Any], message: str, model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match=message):
        parameters(model, **given)


def test_a_parameter_without_a_default_must_be_given(model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match="the task 'arm' needs values for mass"):
        parameters(model, Demanding)
    assert parameters(model, Demanding, mass=2).values["mass"] == 2.0


@pytest.mark.parametrize("name", OPTIONS)
def test_a_parameter_with_the_name_of_an_option_is_refused(name: str, model: mujoco.MjModel) -> None:
    struct = wp.struct(type("Params", (), {"__annotations__": {"dt": float, name: int}, name: 3}))
    message = f"the parameter '{name}' of the task 'arm' has the name of an option of make.*: rename it in Params"
    with pytest.raises(ValueError, match=message):
        parameters(model, struct)


def test_an_element_in_a_field_that_is_not_an_index_is_refused(model: mujoco.MjModel) -> None:
    struct = wp.struct(type("Params", (), {"__annotations__": {"tip": float}, "tip": lw.site("tip")}))
    with pytest.raises(ValueError, match="the parameter tip of 'arm' must be declared as int: it is an index"):
        parameters(model, struct)


@pytest.mark.parametrize("values", [[1.0, 2.0], (1, 2), np.array([1.0, 2.0]), torch.tensor([1.0, 2.0])])
def test_one_value_a_world_may_come_as_any_sequence(values: Any, model: mujoco.MjModel) -> None:
    np.testing.assert_array_equal(parameters(model, gain=values).values["gain"], [1.0, 2.0])


def test_the_array_has_one_entry_until_a_value_differs_between_worlds(model: mujoco.MjModel) -> None:
    device = wp.get_device("cpu")
    shared = parameters(model, offset=(1, 2, 3), lively=True).array(device)
    assert shared.shape == (1,)
    assert (shared.numpy()["gain"].tolist(), shared.numpy()["offset"].tolist()) == ([1.0], [[1.0, 2.0, 3.0]])
    own = parameters(model, gain=[1.0, 2.0], offset=[(1, 2, 3), (4, 5, 6)], count=7).array(device).numpy()
    assert own["gain"].tolist() == [1.0, 2.0]
    assert own["offset"].tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert own["count"].tolist() == [7, 7]


def test_checked_leaves_the_values_as_they_are(model: mujoco.MjModel) -> None:
    values = parameters(model)
    assert values.checked({"gain": 5.0})["gain"] == 5.0
    assert values.values["gain"] == 1.0
