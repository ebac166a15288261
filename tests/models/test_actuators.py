import mujoco
import numpy as np
import pytest

import lyceum_warp as lw
from lyceum_warp.models import unstable_servos

XML = """
<mujoco>
  <worldbody><body><joint name="hinge" axis="0 1 0" damping=".1"/><geom size=".1" mass="1"/></body></worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="4" kv=".2" ctrlrange="-.5 .4"/>
    <position name="free" joint="hinge" kp="400"/>
    <motor name="motor" joint="hinge"/>
  </actuator>
</mujoco>
"""


def test_target_of_a_velocity_servo_stays_in_the_old_control_range() -> None:
    spec = mujoco.MjSpec.from_string(XML)
    for name in ("free", "motor"):
        spec.delete(spec.actuator(name))
    lw.follow_velocity(spec.actuator("servo"), 0.25)
    model = spec.compile()
    servo = model.actuator("servo")
    np.testing.assert_array_equal(servo.ctrlrange, (-0.25, 0.25))
    np.testing.assert_array_equal(servo.actrange, (-0.5, 0.4))
    assert servo.actlimited and servo.ctrllimited
    assert (servo.gainprm[0], *servo.biasprm[:3]) == (4.0, 0.0, -4.0, -0.2)
    data = mujoco.MjData(model)
    found = []
    for _ in range(3):
        for _ in range(500):
            data.ctrl[0] = 9.0  # clipped
            mujoco.mj_step(model, data)
        found.append(float(data.act[0]))
    np.testing.assert_allclose(found, (0.25, 0.4, 0.4), atol=1e-3)
    assert abs(data.qpos[0] - 0.4) < 0.01


@pytest.mark.parametrize(
    ("name", "speed", "message"),
    [
        ("motor", 1.0, "the actuator 'motor' is not a position servo: define it as <position kp="),
        ("free", 1.0, "the actuator 'free' has no range for its target: set the actuator's ctrlrange first"),
        ("servo", -1.0, "speed must be a positive number of m/s or rad/s, not -1.0"),
    ],
)
def test_invalid_actuators_and_speeds_raise_an_error_and_change_nothing(name: str, speed: float, message: str) -> None:
    spec = mujoco.MjSpec.from_string(XML)
    before = spec.to_xml()
    with pytest.raises(ValueError, match=message):
        lw.follow_velocity(spec.actuator(name), speed)
    assert spec.to_xml() == before


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICITFAST"])
@pytest.mark.parametrize("damping", [0.0, 0.6])
def test_servo_is_unstable_beyond_the_longest_stable_substep(integrator: str, damping: float) -> None:
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" type="slide"/><geom size=".1" mass="2"/>
        </body></worldbody>
        <actuator><position name="servo" joint="j" kp="800" kv="{20 * damping}"/></actuator></mujoco>""")
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    model.opt.timestep = 1.0
    (limit,) = unstable_servos(model).values()
    for factor, stable in ((0.98, True), (1.02, False)):
        model.opt.timestep = factor * limit
        assert (not unstable_servos(model)) == stable
        data = mujoco.MjData(model)
        data.qpos[0] = 1e-3
        largest = 0.0
        for _ in range(600):
            mujoco.mj_step(model, data)
            largest = max(largest, abs(data.qpos[0]))  # MuJoCo resets a state that diverges
        assert (largest < 0.1) == stable
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    assert not unstable_servos(model)
