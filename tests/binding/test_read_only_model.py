"""An environment's model refuses edits, and is a model of MuJoCo's in every other respect."""

import copy
import pickle
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from lyceum_warp.binding.read_only_model import ReadOnlyModel, read_only

XML = """
<mujoco model="arm">
  <worldbody><body name="arm"><joint name="hinge" damping="2"/><geom name="ball" size=".1"/></body></worldbody>
  <actuator><motor name="push" joint="hinge"/></actuator>
</mujoco>
"""


def add_in_place(model: mujoco.MjModel) -> None:
    model.body_mass += 1


EDITS: dict[str, Callable[[mujoco.MjModel], object]] = {
    "an element": lambda model: model.body_mass.__setitem__(1, 3.0),
    "a part of a row": lambda model: model.geom_size[0].__setitem__(0, 3.0),
    "in place": add_in_place,
    "a whole array": lambda model: setattr(model, "body_mass", 3.0),
    "a method": lambda model: model.body_mass.fill(3.0),
    "an output": lambda model: np.add(model.body_mass, 1.0, out=model.body_mass),
    "an option": lambda model: setattr(model.opt, "timestep", 3.0),
    "gravity": lambda model: model.opt.gravity.__setitem__(2, 0.0),
    "a picture": lambda model: setattr(model.vis.global_, "offwidth", 3),
    "statistics": lambda model: setattr(model.stat, "extent", 3.0),
    "by name": lambda model: model.body("arm").mass.__setitem__(0, 3.0),
    "by name, whole": lambda model: setattr(model.joint("hinge"), "damping", 3.0),
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_an_edit_is_refused_with_the_way_to_make_it(edit: Callable[[mujoco.MjModel], object]) -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    with pytest.raises(AttributeError, match=r"^env\.model is read-only, .* in startup or randomize, or .* as model=$"):
        edit(model)


def test_a_copy_can_be_edited() -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    for other in (copy.copy(model), copy.deepcopy(model)):
        assert type(other) is mujoco.MjModel
        other.opt.timestep, other.body("arm").mass = 0.5, 3.0
        other.body_mass[0] = 1.0
    assert model.opt.timestep == 0.002
    for array in (model.body_mass.copy(), model.body_mass[[0, 1]], model.body_mass * 2, copy.copy(model.body_mass)):
        array[0] = 3.0
    assert model.body_mass[0] == 0.0


def test_what_is_read_is_what_the_model_says() -> None:
    plain = mujoco.MjModel.from_xml_string(XML)
    model = read_only(plain)
    assert isinstance(model, mujoco.MjModel)
    assert (model.nq, model.names, model.opt.timestep) == (plain.nq, plain.names, plain.opt.timestep)
    assert (model.joint("hinge").damping == 2.0).all()
    assert model.joint("hinge").id == 0
    assert model.body(1).name == "arm"
    assert type(model.body_mass.sum()) is np.float64
    assert type(model.body_mass * 2) is np.ndarray


def test_mujoco_takes_it_like_any_other() -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.model is model
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ball") == 0
    assert Batch(model, 2).nsim == 2
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    assert buffer.any()


def test_it_stays_read_only_when_it_is_pickled() -> None:
    model = pickle.loads(pickle.dumps(read_only(mujoco.MjModel.from_xml_string(XML))))
    assert type(model) is ReadOnlyModel
    with pytest.raises(AttributeError, match=r"env\.model is read-only"):
        model.body_mass[0] = 1.0
    array = pickle.loads(pickle.dumps(model.body_mass))
    array[0] = 1.0
