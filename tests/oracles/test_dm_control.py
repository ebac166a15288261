"""Compare cartpole and cartpole_swingup with dm_control's balance and swingup."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from checks import positions, put_at_random
from conftest import SharedEnv

NWORLD = 256
TASKS = ["cartpole", "cartpole_swingup"]


@pytest.fixture(scope="module")
def dm_cartpole() -> mujoco.MjModel:
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        pytest.skip("dm_control, whose cartpole.xml is the reference, is not installed: pip install dm_control")
    return mujoco.MjModel.from_xml_path(str(Path(package.submodule_search_locations[0], "suite", "cartpole.xml")))


@pytest.mark.parametrize("task", TASKS)
def test_model_has_the_masses_joints_and_motor_of_dm_control(
    shared_env: SharedEnv, dm_cartpole: mujoco.MjModel, task: str
) -> None:
    ours, theirs = shared_env(task).model, dm_cartpole
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


class Physics:
    """dm_control's own class (1.0.50) does not support MuJoCo 4."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.named = SimpleNamespace(data=SimpleNamespace(qpos=self, qvel=self.data.qvel))

    def __setitem__(self, joint: str | slice, value: np.ndarray) -> None:
        self.data.qpos[{"slider": 0, "hinge_1": 1}[joint] if isinstance(joint, str) else joint] = value

    def put(self, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> None:
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = qpos, qvel, action
        mujoco.mj_kinematics(self.model, self.data)

    def cart_position(self) -> float:
        return float(self.data.qpos[0])

    def angular_vel(self) -> np.ndarray:
        return self.data.qvel[1:]

    def pole_angle_cosine(self) -> np.ndarray:
        return self.data.body("pole").xmat[8:]

    def bounded_position(self) -> np.ndarray:
        return np.array([self.data.qpos[0], *self.data.body("pole").xmat[[8, 2]]])

    def velocity(self) -> np.ndarray:
        return self.data.qvel

    def control(self) -> np.ndarray:
        return self.data.ctrl


def balance_task(*, swing_up: bool = False, sparse: bool = False) -> Any:
    module = pytest.importorskip("dm_control.suite.cartpole")
    return module.Balance(swing_up=swing_up, sparse=sparse, random=0)


@pytest.mark.parametrize("sparse", [False, True])
def test_cartpole_has_the_reward_and_observation_of_dm_control(shared_env: SharedEnv, sparse: bool) -> None:
    """Some states are far from the goal, and some actions exceed the control range."""
    env = shared_env("cartpole", nworld=NWORLD, autoreset=False, sparse=sparse)
    theirs, balanced, physics = balance_task(sparse=sparse), balance_task(sparse=True), Physics(env.model)
    rng, rewards = np.random.default_rng(0), []
    for position, velocity in ((0.3, 1.0), (3.0, 8.0)):
        put_at_random(env, rng, position=position, velocity=velocity)
        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 1)).astype(np.float32))
        env.step(action)
        for world, (qpos, qvel) in enumerate(zip(*positions(env), strict=True)):
            physics.put(qpos, qvel, action[world].numpy())
            rewards.append(theirs.get_reward(physics))
            assert env.reward[world].item() == pytest.approx(rewards[-1], abs=2e-6)
            assert bool(env.success[world]) == (balanced.get_reward(physics) == 1.0)
            observation = np.concatenate(list(theirs.get_observation(physics).values()))
            np.testing.assert_allclose(env.obs[world], observation, rtol=1e-6, atol=2e-6)
        assert not env.terminated.any()
    assert np.ptp(rewards) > 0.7
