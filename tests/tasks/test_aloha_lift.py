"""The aloha_lift task: where its model comes from, a scripted lift, the reward's terms, resets and success."""

import mujoco
import numpy as np
import pytest
import torch
from checks import check_uniform, positions
from conftest import SharedEnv
from lifting import follow, joints_at

import lyceum_warp as lw
from lyceum_warp.tasks.aloha_lift import AlohaLift

JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
SIDES = ("left", "right")


def test_the_model_is_in_mujoco_warps_test_data() -> None:
    try:
        AlohaLift.model.path()
    except FileNotFoundError as error:
        pytest.fail(f"this release of mujoco_warp has no ALOHA with a pot, aloha_lift needs another source: {error}")


def test_simple_shapes_replace_the_meshes_and_keep_the_masses(shared_env: SharedEnv) -> None:
    model, original = shared_env("aloha_lift").model, AlohaLift.model.spec().compile()
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    shapes = [mujoco.mjtGeom(kind) for kind in np.unique(model.geom_type[solid])]
    assert shapes == [mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX]
    for i in range(original.nbody):
        name = original.body(i).name
        np.testing.assert_allclose(model.body(name).subtreemass, original.body(i).subtreemass, atol=1e-9, err_msg=name)


def test_shapes_lie_where_the_meshes_do(shared_env: SharedEnv) -> None:
    """Pads of closed fingers touch at the grip, and handles and pot are as far from the pot's axis as their meshes."""
    model = shared_env("aloha_lift").model
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    for side in SIDES:
        for finger in SIDES:
            data.qpos[model.joint(f"{side}\\{finger}_finger").qposadr] = 0.008
    mujoco.mj_forward(model, data)
    handles = [data.site(f"lift/{side}_handle").xpos for side in SIDES]
    assert 0.34 < np.linalg.norm(handles[0] - handles[1]) < 0.36
    for side in SIDES:
        pads = []
        for finger in SIDES:
            body = model.body(f"lift/{side}\\{finger}_finger_link")
            geoms = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
            pads.append(np.mean([data.geom_xpos[i] for i in geoms], axis=0))
        gap = np.linalg.norm(pads[0] - pads[1]) - 2 * 0.005
        assert abs(gap) < 0.002, gap
        middle = np.mean(pads, axis=0) - data.site(f"lift/{side}_grip").xpos
        assert np.linalg.norm(middle) < 0.05


def test_a_scripted_grasp_lifts_the_pot_in_every_world(shared_env: SharedEnv) -> None:
    """To the handles, closed, up: success within an episode, and a reward of nearly 6.5."""
    env = shared_env("aloha_lift", nworld=3, autoreset=False)
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
            # 52 degrees down, one finger above the other
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


def test_reward_weighs_terms_between_0_and_1(shared_env: SharedEnv) -> None:
    env = shared_env("aloha_lift", nworld=16)
    rng = np.random.default_rng(0)
    for _ in range(10):
        action = torch.from_numpy(rng.uniform(-1.0, 1.0, (16, 14)).astype(np.float32))
        env.step(action)
        terms = torch.stack([env.metrics[name] for name in ("reach", "orient", "grasp", "lift")], dim=1)
        assert (terms >= 0.0).all() and (terms <= 1.0 + 1e-6).all()
        expected = terms @ torch.tensor([1.0, 0.5, 1.0, 4.0]) - 0.005 * (action**2).sum(dim=1)
        torch.testing.assert_close(env.reward, expected)
        np.testing.assert_allclose(env.eval, positions(env)[0][:, 18] - 0.0658, atol=1e-6)


def test_success_needs_ten_steps_in_a_row_above_the_goal() -> None:
    """A pot that falls from 1.6 m, upright, is up for 13 steps."""
    env = lw.make("aloha_lift", engine="mujoco", nworld=1, autoreset=False, horizon=0, nthread=1)
    state = env.get_state()
    env.state_space.split(state)["qpos"][:, 16:19] = torch.tensor([0.0, 0.6, 1.65])
    env.set_state(state)
    successes = []
    for _ in range(20):
        env.step(torch.zeros(1, 14))
        successes.append(bool(env.success))
    assert sum(successes) == 4 and not any(successes[:9]) and not successes[-1]


@pytest.mark.usefixtures("freed")
@pytest.mark.parametrize("place", [None, (0.05, 0.01, 0.1)])
def test_random_resets_draw_the_pots_place_and_yaw(place: tuple[float, ...] | None) -> None:
    """Both handles stay in reach: the yaw is drawn around 90 degrees."""
    env = lw.make("aloha_lift", engine="mujoco", nworld=1000, **({} if place is None else {"place": place}))
    env.rand_reset(0)
    qpos, qvel = positions(env)
    pot = qpos[:, 16:]
    yaw = 2.0 * np.arctan2(pot[:, 6], pot[:, 3]) - 0.5 * np.pi
    check_uniform(np.stack([pot[:, 0], pot[:, 1], yaw], axis=1) / (place or (0.03, 0.03, 0.25)) / (1.0 + 1e-5))
    np.testing.assert_allclose(pot[:, 2], 0.0658, atol=1e-7)
    np.testing.assert_allclose(qpos[:, :16], np.tile(env.model.key("start").qpos[:16], (1000, 1)), atol=1e-6)
    assert not pot[:, 4:6].any() and not pot[:, 7].any() and not qvel.any()
