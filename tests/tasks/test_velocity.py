import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.binding import task_names

ROBOTS = [
    task for task in task_names() if task.endswith("_velocity") and task != "go1_velocity" and "rough" not in task
]
NWORLD = 16


@pytest.fixture
def env(task: str, shared_env: SharedEnv) -> lw.Env:
    return shared_env(task, nworld=NWORLD, autoreset=False, push_seconds=(1e6, 1e6))


def feet(env: lw.Env, world: int) -> tuple[np.ndarray, list[bool]]:
    """Compute the heights of the feet with MuJoCo, and whether they touch the ground."""
    model, data = env.model, mujoco.MjData(env.model)
    data.qpos = env.field("qpos")[world]
    mujoco.mj_forward(model, data)
    feet, geoms = env.task.params["feet"], set(env.task.params["foot_geoms"].tolist())
    pairs = [set(pair) for pair in data.contact.geom.tolist()]
    bodies = {
        int(model.geom_bodyid[g])
        for pair in pairs
        if any(model.geom_bodyid[g] == 0 for g in pair)
        for g in pair & geoms
    }
    return data.site_xpos[feet][:, 2], [int(model.site_bodyid[foot]) in bodies for foot in feet]


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_heights_and_contacts_of_feet_equal_those_of_mujoco(task: str, env: lw.Env) -> None:
    rng, touched = np.random.default_rng(0), []
    for step in range(24):
        env.step(torch.from_numpy(rng.normal(size=env.action.shape).astype(np.float32)))
        if step % 8 == 7:
            critic = env.obs_spaces["critic"].split(env.obs_groups["critic"])
            for world in range(NWORLD):
                heights, touching = feet(env, world)
                np.testing.assert_allclose(critic["foot_height"][world], np.clip(heights, 0.0, 1.0), atol=2e-6)
                np.testing.assert_array_equal(critic["foot_contact"][world] > 0, touching)
                touched.append(touching)
    assert 0.1 < np.mean(touched) < 0.99


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_reset_robot_stands_on_its_feet_without_actions(task: str, env: lw.Env) -> None:
    env.reset()
    home, total = env.model.key("home").qpos, []
    np.testing.assert_allclose(env.field("qpos").numpy(), np.tile(home, (NWORLD, 1)), atol=1e-6)
    assert (env.obs_spaces["critic"].split(env.obs_groups["critic"])["foot_height"] < 0.15).all()
    env.rand_reset(0)
    for _ in range(12):
        env.step(torch.zeros(env.action.shape))
        force = env.field("sensordata").reshape(NWORLD, -1, 3).sum(dim=1)[:, 2].abs()
        total.append(force.mean().item())
    weight = 9.81 * float(env.model.body_subtreemass[0])
    assert 0.5 * weight < np.mean(total[4:]) < 1.6 * weight
    held = np.setdiff1d(np.arange(1, env.model.njnt), env.task.params["joints"])
    assert len(held) == env.model.nu - len(env.task.params["joints"])
    if len(held):
        at = env.model.jnt_qposadr[held]
        assert np.abs(env.field("qpos").numpy()[:, at] - home[at]).max() < 0.15


@pytest.mark.parametrize("task", ["spot_velocity"])
def test_robots_with_tables_of_equal_sizes_share_their_kernels(task: str, env: lw.Env, shared_env: SharedEnv) -> None:
    assert env.task.kernels is shared_env("go1_velocity").task.kernels


@pytest.mark.parametrize("task", ["go1_student_velocity", "h1_velocity", "t1_velocity"])
def test_servos_reach_the_forces_of_their_motors_in_the_initial_pose(task: str, env: lw.Env) -> None:
    """Targets that are clipped to a joint's range may leave a servo a fraction of its motor's force."""
    model, joints = env.model, env.task.params["joints"]
    actuators = [int(np.flatnonzero(model.actuator_trnid[:, 0] == joint)[0]) for joint in joints]
    of_joints = np.where(model.jnt_actfrclimited[joints], model.jnt_actfrcrange[joints, 1], np.inf)
    of_servos = np.where(model.actuator_forcelimited[actuators], model.actuator_forcerange[actuators, 1], np.inf)
    env.reset()
    data = mujoco.MjData(model)
    for sign in (-1.0, 1.0):
        data.qpos, data.ctrl = env.field("qpos")[0], 100.0 * sign
        mujoco.mj_forward(model, data)
        force = sign * data.qfrc_actuator[model.jnt_dofadr[joints]]
        np.testing.assert_allclose(force, np.minimum(of_joints, of_servos), rtol=1e-6)
