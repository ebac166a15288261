"""Test aloha_lift. The tests of its reward terms are in test_panda_lift.py."""

import mujoco
import numpy as np
import pytest
from checks import check_uniform, positions
from conftest import SharedEnv
from lifting import follow, joints_at

import lyceum_warp as lw
from lyceum_warp.tasks.aloha_lift import AlohaLift

JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
SIDES = ("left", "right")


def test_simple_shapes_replace_colliding_meshes_without_changing_masses(shared_env: SharedEnv) -> None:
    model, original = shared_env("aloha_lift").model, AlohaLift.model.spec().compile()
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    shapes = [mujoco.mjtGeom(kind) for kind in np.unique(model.geom_type[solid])]
    assert shapes == [mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX]
    for i in range(original.nbody):
        name = original.body(i).name
        np.testing.assert_allclose(model.body(name).subtreemass, original.body(i).subtreemass, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_a_scripted_grasp_lifts_the_pot_in_every_world(shared_env: SharedEnv, physics: str) -> None:
    env = shared_env("aloha_lift", nworld=3, autoreset=False, physics=physics)
    model, start = env.model, positions(env)[0]
    waypoints = np.zeros((3, 3, 14))
    for world in range(3):
        data = mujoco.MjData(model)
        data.qpos[:] = start[world]
        mujoco.mj_kinematics(model, data)
        for k, side in enumerate(SIDES):
            handle = data.site(f"lift/{side}_handle").xpos
            inwards = data.body("partnet_100015/").xpos - handle
            inwards = np.array([*inwards[:2], 0.0]) / np.linalg.norm(inwards[:2])
            # the gripper points 52 degrees downwards, with one finger above the other
            x, y = 0.61 * inwards - [0.0, 0.0, 0.79], 0.79 * inwards + [0.0, 0.0, 0.61]
            axes = np.stack([x, y, np.cross(x, y)], axis=1)
            names = [f"{side}\\{joint}" for joint in JOINTS]
            for i, offset in enumerate((-0.06 * x, 0.0 * x, np.array([0.0, 0.0, 0.16]))):
                qpos = joints_at(model, start[world], f"lift/{side}_grip", handle + offset, axes, names)
                waypoints[i, world, 7 * k : 7 * k + 6] = qpos[8 * k : 8 * k + 6]
                waypoints[i, world, 7 * k + 6] = 0.002 if i == 2 else 0.037
    before, around, up = waypoints
    closed = around.copy()
    closed[:, [6, 13]] = 0.002
    for targets, steps in ((before, 30), (around, 25), (closed, 20), (up, 50)):
        follow(env, targets, steps)
    assert env.success.all() and (env.eval > 0.12).all()
    assert (env.reward > 5.5).all() and not any(env.fault_counts.values())


@pytest.mark.usefixtures("freed")
def test_random_resets_change_the_position_and_yaw_of_the_pot() -> None:
    place = (0.05, 0.01, 0.1)
    env = lw.make("aloha_lift", engine="mujoco", nworld=1000, place=place)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    pot = qpos[:, 16:]
    yaw = 2.0 * np.arctan2(pot[:, 6], pot[:, 3]) - 0.5 * np.pi
    check_uniform(np.stack([pot[:, 0], pot[:, 1], yaw], axis=1) / place / (1.0 + 1e-5))
    np.testing.assert_allclose(pot[:, 2], 0.0658, atol=1e-7)
    np.testing.assert_allclose(qpos[:, :16], np.tile(env.model.key("start").qpos[:16], (1000, 1)), atol=1e-6)
    assert not pot[:, 4:6].any() and not pot[:, 7].any() and not qvel.any()
