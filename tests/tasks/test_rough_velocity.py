from collections.abc import Mapping

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.velocity.rough import TERRAIN

TASKS = ["go1_rough_velocity", "g1_rough_velocity"]
LAST = TERRAIN.levels - 1
NWORLD = 20


@pytest.fixture
def env(task: str, shared_env: SharedEnv) -> lw.Env:
    return shared_env(task, nworld=NWORLD, autoreset=False, push_seconds=(1e6, 1e6))


def parts(env: lw.Env, group: str) -> Mapping[str, torch.Tensor]:
    found: Mapping[str, torch.Tensor] = env.obs_spaces[group].split(env.obs_groups[group])
    return found


def ray_height(model: mujoco.MjModel, data: mujoco.MjData, x: float, y: float) -> float:
    (field,) = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
    start, down = np.array([x, y, 9.0]), np.array([0.0, 0.0, -1.0])
    return 9.0 - float(mujoco.mj_rayHfield(model, data, field, start, down, None))


def put(env: lw.Env, world: int, x: float, y: float) -> None:
    data = mujoco.MjData(env.model)
    mujoco.mj_forward(env.model, data)
    around = np.linspace(-0.4, 0.4, 9)
    top = max(ray_height(env.model, data, x + i, y + j) for i in around for j in around)
    state = env.get_state()
    qpos = env.state_space.split(state)["qpos"]
    qpos[world, :3] = torch.tensor([x, y, top + float(env.task.params["start_height"])])
    env.set_state(state)


@pytest.mark.quick("go1_rough_velocity")
@pytest.mark.parametrize("task", TASKS)
def test_heights_contacts_and_scans_on_every_kind_of_patch_equal_those_of_mujoco(task: str, env: lw.Env) -> None:
    env.reset()
    for world, (x, y, _) in enumerate(TERRAIN.origins[LAST]):
        put(env, world, x + 2.0, y + 0.3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        env.step(torch.from_numpy((0.5 * rng.normal(size=env.action.shape)).astype(np.float32)))
    model, data = env.model, mujoco.MjData(env.model)
    feet, geoms = env.task.params["feet"], set(env.task.params["foot_geoms"].tolist())
    grid, equal, touched = env.task.params["scan"], 0, 0
    critic = {name: part.numpy() for name, part in parts(env, "critic").items()}
    for world in range(NWORLD):
        data.qpos = env.field("qpos")[world]
        mujoco.mj_forward(model, data)
        sites = data.site_xpos[feet]
        heights = [np.clip(z - ray_height(model, data, x, y), 0.0, 1.0) for x, y, z in sites]
        np.testing.assert_allclose(critic["foot_height"][world], heights, atol=1e-4)
        down = {int(model.geom_bodyid[g]) for pair in data.contact.geom for g in set(pair.tolist()) & geoms}
        touching = [int(model.site_bodyid[foot]) in down for foot in feet]
        equal += int((critic["foot_contact"][world] == touching).sum())
        touched += sum(touching)
        forward = data.xmat[env.task.params["trunk"]].reshape(3, 3)[:2, 0]
        forward /= np.linalg.norm(forward)
        points = data.qpos[:2] + grid[::7] @ np.array([forward, [-forward[1], forward[0]]])
        scan = [data.qpos[2] - ray_height(model, data, x, y) for x, y in points]
        np.testing.assert_allclose(critic["height_scan"][world, ::7], scan, atol=2e-4)
    # a foot may stand on an edge that lies between the corners of its sole
    assert equal > 0.8 * NWORLD * len(feet) and touched > NWORLD / 2
    noise = (parts(env, "policy")["height_scan"] - parts(env, "critic")["height_scan"]).abs()
    assert noise.max() <= 0.1 + 1e-5 and noise.mean() > 0.03


@pytest.mark.quick("go1_rough_velocity")
@pytest.mark.parametrize("task", TASKS)
def test_robots_start_at_their_level_and_reach_higher_levels_by_walking(task: str, env: lw.Env) -> None:
    def memory(name: str) -> torch.Tensor:
        return env.state_space.split(env.get_state())[name][:, 0].int()

    columns = memory("column")
    assert len(set(columns.tolist())) > 5 and not memory("level").any()
    for level in range(3):
        middle = torch.from_numpy(TERRAIN.origins[level])[columns.long()]
        assert ((env.field("qpos")[:, :2] - middle[:, :2]).abs() <= 0.5 + 1e-5).all()
        for world in range(NWORLD):
            put(env, world, float(middle[world, 0]) + 0.5 * TERRAIN.patch + 0.1, float(middle[world, 1]))
        env.step()
        env.rand_reset()
        assert (memory("level") == level + 1).all() and (memory("column") == columns).all()
    env.step()
    commanded = parts(env, "critic")["command"][:, :2].norm(dim=1) > 0.2
    env.rand_reset()
    assert commanded.any() and (memory("level")[commanded] == 2).all()


@pytest.mark.quick("go1_rough_velocity")
@pytest.mark.parametrize("task", TASKS)
def test_robot_that_leaves_its_patch_goes_on_one_level_higher_in_the_same_episode(task: str, env: lw.Env) -> None:
    env.set_params(climbing=True)
    middles = torch.from_numpy(TERRAIN.origins)
    column = env.state_space.split(env.get_state())["column"][:, 0].long()
    for level in range(2):
        walking = env.get_state()
        env.state_space.split(walking)["drawn_velocity"][:] = torch.tensor([1.0, 0.0, 0.0])
        env.set_state(walking)
        for world in range(NWORLD):
            x, y, _ = middles[level, column[world]].tolist()
            put(env, world, x, y + 0.5 * TERRAIN.patch + 0.1)
        joints = env.field("qpos")[:, 7:].clone()
        env.step()
        position = env.field("qpos")
        away = position[:, :2] - middles[level + 1, column, :2]
        assert (away.abs() <= 0.5 + 1e-5).all() and (position[:, 7:] - joints).abs().max() < 0.2
        assert not env.done.any() and (env.episode_step == level + 1).all()
        assert (parts(env, "critic")["foot_height"] > -0.02).all() and (env.metrics["terrain_level"] == level).all()
    env.rand_reset()
    levels = env.state_space.split(env.get_state())["level"][:, 0]
    assert (levels == 2.0).all()  # a fall after a rise does not lower the level
    env.set_params(climbing=False)
    put(env, 0, *(middles[2, column[0], :2] + 0.6 * TERRAIN.patch).tolist())
    env.step()
    assert (env.field("qpos")[0, :2] - middles[2, column[0], :2]).min() > 4.0


@pytest.mark.parametrize("task", TASKS)
def test_robot_outside_the_field_ends_the_episode(task: str, env: lw.Env) -> None:
    state = env.get_state()
    env.state_space.split(state)["qpos"][0, 0] = 100.0
    env.set_state(state)
    env.step()
    assert env.truncated.nonzero().flatten().tolist() == [0] and not env.terminated.any()
    assert env.metrics["left_field"].tolist() == [1.0] + (NWORLD - 1) * [0.0]


@pytest.mark.long
@pytest.mark.quick("go1_rough_velocity")
@pytest.mark.parametrize("task", TASKS)
def test_falling_robot_on_rough_ground_has_bounded_velocities_under_mujoco_warp(
    task: str, shared_env: SharedEnv
) -> None:
    """For the box soles of the original G1, MuJoCo Warp finds contact normals that point down."""
    env = shared_env(task, engine="warp", nworld=24)
    rng = np.random.default_rng(0)
    for _ in range(60):
        env.step(torch.from_numpy((0.5 * rng.normal(size=env.action.shape)).astype(np.float32)))
        assert env.field("qvel").abs().max() < 60.0
