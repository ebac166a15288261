from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from lyceum_warp import walkers

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".4" priority="1" condim="3" margin=".002"/>
    <body name="trunk" pos="0 0 .5" euler="0 0 30">
      <freejoint/>
      <geom type="box" size=".2 .1 .05" contype="0" conaffinity="0"/>
      <body name="thigh" pos="0 .1 -.05" euler="20 0 10">
        <joint name="hip_x" axis="1 .2 0" pos="0 .02 .01" ref="15"/>
        <joint name="hip_y" axis="0 1 0" pos="0 0 .03" actuatorfrcrange="-30 30"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" contype="0" conaffinity="0"/>
        <body pos="0 0 -.2" euler="0 15 0"><body name="shin" pos=".01 0 0">
          <joint name="knee" axis="0 1 .1" range="-2 2"/>
          <geom name="ball" type="{shape}" size=".03 .04 .02" pos=".02 0 -.15" euler="10 20 0"/>
          <geom name="shield" size=".04" pos="0 0 -.1" contype="0" conaffinity="0"/>
          <site name="ankle" pos=".02 0 -.15"/>
        </body></body>
      </body>
      <body name="peg" pos="0 -.1 0">
        <joint name="peg" axis="0 1 0"/>
        <geom name="end" size=".02" pos="0 0 -.45"/><site name="peg_end" pos="0 0 -.45"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="turn_knee" joint="knee" gear="-5" ctrlrange="-4 4"/>
    <position name="turn_hip" joint="hip_y" kp="60"/>
    <motor name="turn_peg" joint="peg"/>
  </actuator>
  <sensor><gyro site="ankle"/></sensor>
</mujoco>
"""
"""A robot with a leg of 3 joints and a leg of 1 joint.

One body has two joints away from its origin. One of these joints has ``ref``. Another body is fixed.
"""


def made(shape: str = "box", feet: tuple[str, ...] = ("ankle", "peg_end")) -> tuple[mujoco.MjModel, SimpleNamespace]:
    model = mujoco.MjModel.from_xml_string(XML.format(shape=shape))
    p = SimpleNamespace(feet=[model.site(name).id for name in feet], joints=[])
    p.foot_geoms = walkers.foot_geoms(model, p)
    return model, p


def rotated(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, vector, quat)
    return out


def last_joint(model: mujoco.MjModel, p: SimpleNamespace, data: mujoco.MjData, foot: int) -> list[np.ndarray]:
    qpos, axes, offsets = (table(model, p)[foot] for table in (walkers.leg_qpos, walkers.leg_axes, walkers.leg_offsets))
    x, turn = data.qpos[:3].copy(), data.qpos[3:7].copy()
    for at, axis, offset in zip(qpos, axes, offsets, strict=True):
        if at >= 0:
            x += rotated(turn, offset)
            step, product = np.zeros(4), np.zeros(4)
            mujoco.mju_axisAngle2Quat(step, axis, data.qpos[at])
            mujoco.mju_mulQuat(product, turn, step)
            turn = product
    return [x, turn]


def random_states(model: mujoco.MjModel, count: int) -> list[mujoco.MjData]:
    rng, states = np.random.default_rng(0), []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qpos[7:] = rng.normal(size=model.nq - 7) * 0.7
        data.qpos[:3] = rng.uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 0.5])
        data.qpos[3:7] = rng.normal(size=4) * 0.2 + [1.0, 0.0, 0.0, 0.0]
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_forward(model, data)
        states.append(data)
    return states


@pytest.mark.parametrize("shape", ["sphere", "capsule", "box"])
def test_kinematic_tables_give_the_positions_and_contacts_of_feet(shape: str) -> None:
    model, p = made(shape)
    assert walkers.leg_joints(model, p).tolist() == [[1, 2, 3], [4, -1, -1]]
    assert [model.geom(geom).name for geom in p.foot_geoms] == ["ball", "end"]
    soles, offsets = walkers.soles(model, p), walkers.foot_offsets(model, p)
    touched = 0
    for data in random_states(model, 100):
        for foot, site in enumerate(p.feet):
            x, turn = last_joint(model, p, data, foot)
            np.testing.assert_allclose(x + rotated(turn, offsets[foot]), data.site_xpos[site], atol=1e-12)
            lowest = min(x[2] + rotated(turn, sphere[:3])[2] - sphere[3] for sphere in soles[foot])
            wanted = any({0, p.foot_geoms[foot]} == set(pair) for pair in data.contact.geom.tolist())
            assert (lowest <= 0) == wanted
            touched += wanted
    assert 20 < touched < 180


@pytest.mark.parametrize("shape", ["cylinder", "ellipsoid"])
def test_feet_of_other_shapes_touch_the_ground_at_the_corners_of_their_boxes(shape: str) -> None:
    """No point of the foot is lower than the lowest corner of its bounding box."""
    model, p = made(shape)
    soles = walkers.soles(model, p)
    for data in random_states(model, 50):
        x, turn = last_joint(model, p, data, 0)
        lowest = min(x[2] + rotated(turn, sphere[:3])[2] - sphere[3] for sphere in soles[0])
        touching = any({0, p.foot_geoms[0]} == set(pair) for pair in data.contact.geom.tolist())
        assert lowest <= 0 or not touching


def test_models_without_a_base_or_legs_raise_an_error() -> None:
    model, p = made()
    p.feet = [model.site("ankle").id]
    arm = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="first joint of the model is not a free joint"):
        walkers.base(arm)
    with pytest.raises(ValueError, match="no joint connects the body 'trunk' of a foot to the base 'trunk'"):
        walkers.leg_of(model, 1)
    with pytest.raises(
        ValueError, match="no sensor 'ankle_force' of a contact's force: prepare_walker adds this sensor"
    ):
        walkers.foot_forces(model, p)
    p.joints = [model.joint("hip_x").id]
    with pytest.raises(ValueError, match="joint 'hip_x' has 0 actuators but needs exactly one"):
        walkers.controls(model, p)
    p.joints = [model.joint("peg").id]
    with pytest.raises(ValueError, match="servo of the joint 'peg' has no force limit: pass action_scale"):
        walkers.quarter_of_force(model, p)


def test_prepared_model_has_force_sensors_and_foot_friction() -> None:
    spec = mujoco.MjSpec.from_string(XML.format(shape="box"))
    walkers.prepare_walker(spec, ["ankle", "peg_end"], timestep=0.004, iterations=(3, 5))
    model = spec.compile()
    p = SimpleNamespace(feet=[model.site(name).id for name in ("ankle", "peg_end")])
    assert (model.opt.timestep, model.opt.iterations, model.opt.ls_iterations) == (0.004, 3, 5)
    assert walkers.foot_forces(model, p) == [0, 3] and model.nsensordata == 6
    data = mujoco.MjData(model)
    data.qpos[2] = 0.44
    mujoco.mj_forward(model, data)
    assert data.sensordata[5] < -1.0
    assert (data.contact.friction[:, 0] == 1.0).all(), "the feet's, not the floor's"
    with pytest.raises(ValueError, match="no site 'toe' for a foot"):
        walkers.prepare_walker(spec, ["toe"])


def test_contact_pairs_with_the_ground_are_replaced_by_contacts_of_the_feet() -> None:
    xml = XML.format(shape="box").replace('name="end" size=".02"', 'name="end" size=".02" contype="0" conaffinity="0"')
    pair = '<contact><pair geom1="end" geom2="floor" condim="3"/><pair geom1="end" geom2="ball"/></contact></mujoco>'
    spec = mujoco.MjSpec.from_string(xml.replace("</mujoco>", pair))
    walkers.prepare_walker(spec, ["ankle", "peg_end"])
    assert [{pair.geomname1, pair.geomname2} for pair in spec.pairs] == [{"end", "ball"}]
    model = spec.compile()
    assert walkers.contact_geoms(model, model.body("peg").id) == [model.geom("end").id]


def test_motors_are_replaced_by_critically_damped_servos_with_the_same_limits() -> None:
    spec = mujoco.MjSpec.from_string(XML.format(shape="box"))
    walkers.use_servos(spec, ["hip_y", "knee"], reach=0.5)
    model = spec.compile()
    knee, hip = model.actuator("turn_knee"), model.actuator("turn_hip")
    assert knee.forcerange.tolist() == [-20.0, 20.0] and knee.gear[0] == 1.0 and not model.actuator_ctrllimited[0]
    kp, kd = knee.gainprm[0], -knee.biasprm[2]
    assert kp == 40.0 and knee.biasprm[1] == -40.0 and hip.gainprm[0] == 60.0
    inertia = mujoco.MjModel.from_xml_string(XML.format(shape="box")).dof_M0[model.joint("knee").dofadr[0]]
    assert kd == pytest.approx(2 * np.sqrt(kp * inertia))
    with pytest.raises(ValueError, match="motor of the joint 'peg' has no limit: give it a ctrlrange or a forcerange"):
        walkers.use_servos(spec, ["peg"])


def test_foot_sites_are_added_at_a_named_element_of_their_body() -> None:
    spec = mujoco.MjSpec.from_string(XML.format(shape="box"))
    walkers.add_feet(spec, {"a": ("shin", (0.0, 0.0, -0.1)), "b": ("peg", (0.0, 0.0, 0.1)), "c": ("end", (0.0,) * 3)})
    model = spec.compile()
    bodies = [model.body(model.site(name).bodyid[0]).name for name in ("a", "b", "c")]
    assert bodies == ["shin", "peg", "peg"] and model.site("a").pos.tolist() == [0.0, 0.0, -0.1]
    with pytest.raises(ValueError, match="no body, joint or geom 'toe' for the foot 'd'"):
        walkers.add_feet(spec, {"d": ("toe", (0.0, 0.0, 0.0))})


def test_round_feet_keep_the_height_and_friction_of_the_boxes() -> None:
    spec = mujoco.MjSpec.from_string(XML.format(shape="box"))
    before = spec.copy().compile()
    walkers.prepare_walker(spec, ["ankle", "peg_end"])
    walkers.round_feet(spec, ["ankle", "peg_end"], radius=0.01)
    model = spec.compile()
    np.testing.assert_allclose(model.body_inertia, before.body_inertia)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    box, geoms = model.geom("ball").id, walkers.contact_geoms(model, model.body("shin").id)
    assert len(geoms) == 2 and (model.geom_type[geoms] == int(mujoco.mjtGeom.mjGEOM_CAPSULE)).all()
    assert (model.geom_friction[geoms] == model.geom_friction[box]).all() and (model.geom_priority[geoms] == 1).all()
    place = [walkers.spheres_of(model, data, geom) for geom in geoms]
    inside = (np.concatenate(place)[:, :3] - data.geom_xpos[box]) @ data.geom_xmat[box].reshape(3, 3)
    # the ends of the capsules touch the sides and the bottom of the box, whose half-sizes are 0.03, 0.04 and 0.02
    np.testing.assert_allclose(sorted(map(tuple, abs(inside).round(9))), 4 * [(0.02, 0.03, 0.01)], atol=1e-9)
    assert (inside[:, 2] < 0.0).all()
    with pytest.raises(ValueError, match=r"'ankle' is 0\.06 m wide: use a smaller radius"):
        spec.geom("ball").contype = 1
        walkers.round_feet(spec, ["ankle"], radius=0.05)
