import mujoco
import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp.core import vec10
from lyceum_warp.core.fields import describe, elements
from lyceum_warp.core.task import Element

XML = """
<mujoco>
  <worldbody>
    <site name="here"/><camera name="eye"/>
    <body name="target" mocap="true"><geom size=".1" contype="0" conaffinity="0"/></body>
    <body name="base"><freejoint name="root"/><geom name="hull" size=".1"/><site name="tip"/>
      <body name="arm" pos=".5 0 0"><joint name="elbow"/><geom size=".1"/></body>
    </body>
  </worldbody>
  <actuator><orientation name="aim" site="tip" refsite="here" kp="1"/><motor name="turn" joint="elbow"/>
    <position name="slow" joint="elbow" timeconst=".1"/></actuator>
  <tendon><fixed name="string"><joint joint="elbow" coef="1"/></fixed></tendon>
  <equality><joint name="held" joint1="elbow" polycoef="0 0 0 0 0"/></equality>
  <deformable><flex name="cloth" dim="1" body="base arm" vertex="0 0 0 0 0 0" element="0 1"/></deformable>
  <sensor><framepos name="place" objtype="site" objname="tip"/><accelerometer name="shock" site="tip"/></sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.mark.parametrize(
    ("name", "shape", "dtype"),
    [
        ("time", (), wp.float32),
        ("qpos", (8,), wp.float32),
        ("site_xpos", (2,), wp.vec3),
        ("xquat", (4,), lw.quat),
        ("xmat", (4,), wp.mat33),
        ("cvel", (4,), wp.spatial_vector),
        ("cinert", (4,), vec10),
        ("eq_active", (1,), wp.bool),
        ("flexvert_xpos", (2,), wp.vec3),
        ("energy", (2,), wp.float32),
    ],
)
def test_field_has_the_type_of_its_elements_and_the_size_of_the_mujoco_array(
    name: str, shape: tuple[int, ...], dtype: type, model: mujoco.MjModel
) -> None:
    field = describe(model, name)
    assert (field.shape, field.dtype) == (shape, dtype)
    assert field.size == np.size(getattr(mujoco.MjData(model), name))


@pytest.mark.parametrize(
    ("name", "element", "where"),
    [
        ("qpos", "root", slice(0, 7)),
        ("qvel", "root", slice(0, 6)),
        ("qacc", "elbow", slice(6, 7)),
        ("qfrc_applied", "elbow", slice(6, 7)),
        ("geom_xpos", "hull", slice(1, 2)),
        ("site_xmat", "tip", slice(1, 2)),
        ("ctrl", "aim", slice(0, 3)),
        ("actuator_gear", "aim", slice(0, 3)),
        ("actuator_gainprm", "turn", slice(1, 2)),
        ("actuator_ctrlrange", "turn", slice(3, 4)),
        ("tendon_stiffness", "string", slice(0, 1)),
        ("eq_solref", "held", slice(0, 1)),
        ("flexvert_xpos", "cloth", slice(0, 2)),
        ("body_mass", "arm", slice(3, 4)),
        ("geom_friction", "hull", slice(1, 2)),
        ("dof_damping", "root", slice(0, 6)),
        ("jnt_range", "elbow", slice(1, 2)),
        ("qpos0", "elbow", slice(7, 8)),
        ("site_pos", "tip", slice(1, 2)),
        ("sensordata", "shock", slice(3, 6)),
    ],
)
def test_name_of_an_element_gives_its_indices_in_a_field(
    name: str, element: str, where: slice, model: mujoco.MjModel
) -> None:
    assert elements(model, name, element) == where


@pytest.mark.parametrize(
    ("element", "place"),
    [
        (lw.actuator("turn"), 3),
        (lw.ctrl("turn"), 3),
        (lw.act("slow"), 0),
        (lw.tendon("string"), 0),
        (lw.equality("held"), 0),
        (lw.joint("elbow"), 1),
        (lw.dof("elbow"), 6),
        (lw.qpos("elbow"), 7),
        (lw.body("arm"), 3),
        (lw.camera("eye"), 0),
        (lw.mocap("target"), 0),
    ],
)
def test_default_of_a_parameter_may_be_a_named_element(element: Element, place: int, model: mujoco.MjModel) -> None:
    assert elements(model, element.field, element.name).start == place


@pytest.mark.parametrize(
    ("name", "element", "message"),
    [
        ("site_xpos", "hand", "the model has no site 'hand'; it has: here, tip"),
        ("qpos", "knee", "the model has no joint 'knee'; it has: elbow, root"),
        ("light_xpos", "lamp", "the model has no light 'lamp'; it has: none"),
        ("mocap_pos", "arm", "the body 'arm' is .* mocap body, so it has no 'mocap_pos'"),
        ("time", "noon", "the field 'time' has no named elements"),
        ("gravity", "down", "the field 'gravity' has no named elements"),
        ("act", "turn", "the actuator 'turn' has no 'act'"),
    ],
)
def test_an_unknown_element_is_refused(name: str, element: str, message: str, model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match=message):
        elements(model, name, element)
