import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import TASKS

ROBOTS = [task for task in TASKS if task != "go1_velocity" and "rough" not in task]
NWORLD = 16


@pytest.fixture
def env(task: str, shared_env: SharedEnv) -> lw.Env:
    return shared_env(task, nworld=NWORLD, autoreset=False, push_seconds=(1e6, 1e6))


def random_steps(env: lw.Env, steps: int, size: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(torch.from_numpy((size * rng.normal(size=env.action.shape)).astype(np.float32)))


def feet(env: lw.Env, world: int) -> tuple[mujoco.MjData, list[bool]]:
    model, data = env.model, mujoco.MjData(env.model)
    data.qpos, data.qvel = env.field("qpos")[world], env.field("qvel")[world]
    mujoco.mj_forward(model, data)
    geoms = set(env.task.params["foot_geoms"].tolist())
    pairs = [set(pair) for pair in data.contact.geom.tolist()]
    bodies = [
        {int(model.geom_bodyid[g]) for g in pair & geoms}
        for pair in pairs
        if any(model.geom_bodyid[g] == 0 for g in pair)
    ]
    return data, [any(int(model.site_bodyid[foot]) in found for found in bodies) for foot in env.task.params["feet"]]


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_heights_and_contacts_of_feet_equal_those_of_mujoco(task: str, env: lw.Env) -> None:
    n = len(env.task.params["feet"])
    touched = 0
    for _ in range(3):
        random_steps(env, 8, 1.0)
        critic = env.obs_spaces["critic"].split(env.obs_groups["critic"])
        for world in range(NWORLD):
            data, touching = feet(env, world)
            heights = np.clip([data.site_xpos[foot][2] for foot in env.task.params["feet"]], 0.0, 1.0)
            np.testing.assert_allclose(critic["foot_height"][world], heights, atol=2e-6)
            np.testing.assert_array_equal(critic["foot_contact"][world] > 0, touching)
            touched += sum(touching)
    assert 0.1 < touched / (3 * NWORLD * n) < 0.99


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_velocities_of_feet_equal_those_of_mujoco(task: str, env: lw.Env) -> None:
    """The metric ``foot_slip`` is the squared horizontal speed of feet in contact.

    The task multiplies it by the weight and the duration of a step.
    """
    random_steps(env, 12, 1.0)
    env.set_params(least_command=-1.0)
    random_steps(env, 1, 1.0)
    motion, clock = np.zeros(6), env.state_space.split(env.get_state())["contact_time"].numpy()
    slips = []
    for world in range(NWORLD):
        data, _ = feet(env, world)
        slip = 0.0
        for foot, seconds in zip(env.task.params["feet"], clock[world], strict=True):
            mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_SITE, foot, motion, 0)
            slip += (seconds > 0) * float(motion[3:5] @ motion[3:5])
        slips.append(slip)
    found = env.metrics["foot_slip"].numpy()
    env.set_params(least_command=0.05)
    np.testing.assert_allclose(found, -0.1 * 0.02 * np.array(slips), rtol=2e-4, atol=1e-7)
    assert np.count_nonzero(found) > NWORLD / 4


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_feet_of_a_standing_robot_carry_its_weight(task: str, env: lw.Env) -> None:
    total = []
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
        home = env.model.key("home").qpos[at]
        assert np.abs(env.field("qpos").numpy()[:, at] - home).max() < 0.15


@pytest.mark.quick("g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_resets_put_the_robot_above_the_ground(task: str, env: lw.Env) -> None:
    env.reset()
    critic = env.obs_spaces["critic"].split(env.obs_groups["critic"])
    qpos = env.field("qpos").numpy()
    np.testing.assert_allclose(qpos, np.tile(env.model.key("home").qpos, (NWORLD, 1)), atol=1e-6)
    assert (critic["foot_height"] < 0.15).all(), "feet are near the ground"


@pytest.mark.parametrize("task", ["spot_velocity"])
def test_robots_with_tables_of_equal_sizes_share_their_kernels(task: str, env: lw.Env, shared_env: SharedEnv) -> None:
    assert env.task.kernels is shared_env("go1_velocity").task.kernels
