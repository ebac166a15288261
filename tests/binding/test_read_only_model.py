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

EDITS: dict[str, Callable[[mujoco.MjModel], object]] = {
    "an element": lambda model: model.body_mass.__setitem__(1, 3.0),
    "an output": lambda model: np.add(model.body_mass, 1.0, out=model.body_mass),
    "a whole array": lambda model: setattr(model, "body_mass", 3.0),
    "an option": lambda model: setattr(model.opt, "timestep", 3.0),
    "gravity": lambda model: model.opt.gravity.__setitem__(2, 0.0),
    "by name": lambda model: model.body("arm").mass.__setitem__(0, 3.0),
    "by name, whole": lambda model: setattr(model.joint("hinge"), "damping", 3.0),
}


@pytest.mark.parametrize("pickled", [False, True])
@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_edit_of_the_model_raises_an_error(edit: Callable[[mujoco.MjModel], object], pickled: bool) -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    if pickled:
        model = pickle.loads(pickle.dumps(model))
        assert type(model) is ReadOnlyModel
    own = r"^env\.model is read-only, .* in startup or randomize, or .* as model=$"
    message = rf"{own}|^(assignment destination|output array) is read-only$"
    with pytest.raises((AttributeError, ValueError), match=message):
        edit(model)
    assert (model.body_mass == mujoco.MjModel.from_xml_string(XML).body_mass).all()


def test_copy_of_a_read_only_model_can_be_edited() -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    for other in (copy.copy(model), copy.deepcopy(model)):
        assert type(other) is mujoco.MjModel
        other.opt.timestep, other.body("arm").mass = 0.5, 3.0
        other.body_mass[0] = 1.0
    for array in (model.body_mass.copy(), model.body_mass * 2, copy.copy(model.body_mass)):
        array[0] = 3.0
    assert model.opt.timestep == 0.002 and model.body_mass[0] == 0.0


def test_mujoco_accepts_the_read_only_model() -> None:
    model = read_only(mujoco.MjModel.from_xml_string(XML))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.model is model
    assert (model.joint("hinge").id, model.body(1).name) == (0, "arm")
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ball") == 0
    assert Batch(model, 2).nsim == 2
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    assert buffer.any()
