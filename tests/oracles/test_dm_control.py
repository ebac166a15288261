"""The cartpole_swingup task's model against dm_control's."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import SharedEnv


@pytest.fixture(scope="module")
def dm_cartpole() -> mujoco.MjModel:
    """dm_control's cartpole, read from its file; dm_control itself is not imported."""
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        pytest.skip("dm_control, whose cartpole.xml is the reference, is not installed: pip install dm_control")
    return mujoco.MjModel.from_xml_path(str(Path(package.submodule_search_locations[0], "suite", "cartpole.xml")))


def test_model_has_dm_controls_masses_joints_and_motor(shared_env: SharedEnv, dm_cartpole: mujoco.MjModel) -> None:
    """Masses, inertias, joints and motor are dm_control's."""
    ours, theirs = shared_env("cartpole_swingup").model, dm_cartpole
    for name in (
        "body_mass", "body_inertia", "body_pos", "body_ipos", "body_iquat",
        "jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_solref", "jnt_solimp", "jnt_stiffness",
        "dof_damping", "dof_armature", "dof_frictionloss",
        "actuator_gear", "actuator_ctrlrange", "actuator_ctrllimited", "actuator_gainprm", "actuator_biasprm",
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, atol=1e-12, err_msg=name)
    for name in ("timestep", "integrator", "gravity", "solver", "viscosity", "density"):
        assert np.array_equal(getattr(ours.opt, name), getattr(theirs.opt, name)), name
    contacts = mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert ours.opt.disableflags & contacts == theirs.opt.disableflags & contacts == contacts


@pytest.mark.parametrize("hold", [1, 25])
def test_same_controls_lead_to_the_same_trajectory(
    shared_env: SharedEnv, dm_cartpole: mujoco.MjModel, hold: int
) -> None:
    """Controls that are held for 25 steps drive the cart against both ends of the rail."""
    ours, theirs = shared_env("cartpole_swingup").model, dm_cartpole
    rng = np.random.default_rng(hold)
    a, b = mujoco.MjData(ours), mujoco.MjData(theirs)
    a.qpos[:] = b.qpos[:] = rng.uniform(-1.0, 1.0, 2) * (1.0, np.pi)
    a.qvel[:] = b.qvel[:] = rng.uniform(-1.0, 1.0, 2)
    cart = []
    for i in range(500):
        if i % hold == 0:
            a.ctrl[:] = b.ctrl[:] = rng.uniform(-1.5, 1.5, 1)
        mujoco.mj_step(ours, a)
        mujoco.mj_step(theirs, b)
        np.testing.assert_allclose(a.qpos, b.qpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.qvel, b.qvel, rtol=0, atol=1e-9)
        cart.append(a.qpos[0])
    if hold > 1:
        assert min(cart) < -1.7 and max(cart) > 1.7
