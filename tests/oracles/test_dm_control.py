"""Compare cartpole and cartpole_swingup with the tasks of dm_control's suite."""

import mujoco
import numpy as np
import pytest
import torch
from checks import put_at_random
from conftest import SharedEnv

NWORLD = 256
SUITE = {"cartpole": "dm/cartpole_balance", "cartpole_swingup": "dm/cartpole_swingup"}


@pytest.mark.parametrize("task", SUITE)
def test_model_has_the_masses_joints_and_motor_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    ours, theirs = (shared_env(name, nworld=NWORLD, autoreset=False).model for name in (task, SUITE[task]))
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


@pytest.mark.parametrize("sparse", [False, True])
def test_cartpole_has_the_reward_and_observation_of_dm_control(shared_env: SharedEnv, sparse: bool) -> None:
    options = {"nworld": NWORLD, "autoreset": False, "sparse": sparse}
    ours, theirs = (shared_env(name, **options) for name in ("cartpole", SUITE["cartpole"]))
    rng, rewards = np.random.default_rng(0), []
    for position, velocity in ((0.3, 1.0), (3.0, 8.0)):
        theirs.set_state(put_at_random(ours, rng, position=position, velocity=velocity))
        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 1)).astype(np.float32))
        for env in (ours, theirs):
            env.step(action)
        torch.testing.assert_close(ours.obs, theirs.obs, rtol=1e-6, atol=2e-6)
        torch.testing.assert_close(ours.reward, theirs.reward, rtol=0.0, atol=2e-6)
        assert not ours.terminated.any()
        assert not sparse or torch.equal(ours.success, theirs.reward == 1.0)
        rewards.append(theirs.reward.clone())
    assert np.ptp(torch.cat(rewards).numpy()) > 0.7
