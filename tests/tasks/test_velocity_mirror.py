import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp import walkers
from lyceum_warp.algos.symmetry import Reflected, reflections
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.registry import find_task
from lyceum_warp.tasks.velocity import TASKS

ROBOTS = [task for task in TASKS if "rough" not in task]
FLIP = np.diag([1.0, -1.0, 1.0])


def bound(task: str) -> BoundTask:
    try:
        return BoundTask(find_task(task))
    except (FileNotFoundError, ImportError) as error:
        pytest.skip(str(error))


def symmetric(model: mujoco.MjModel, mirror: lw.Mirror) -> mujoco.MjModel:
    """Return a symmetric model: each mass, gain and range is the mean of its left and right value.

    Published models are not symmetric. Left and right centres of mass differ by up to 6 mm, and both hips of the G1
    have the range of the left hip.
    """
    model, data = copy.copy(model), mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    order, signs = (np.array(part[6:]) for part in mirror.parts["qvel"])
    order -= 5
    ranges = model.jnt_range[order].copy()
    ranges = np.where(signs[:, None] > 0.0, ranges, -ranges[:, ::-1])
    model.jnt_range[1:] = 0.5 * (model.jnt_range[1:] + ranges)
    moved = model.actuator_trnid[:, 0].tolist()
    partners = [moved.index(order[joint - 1]) for joint in moved]
    model.actuator_ctrlrange[:] = model.jnt_range[moved]
    model.actuator_biasprm[:] = 0.5 * (model.actuator_biasprm + model.actuator_biasprm[partners])
    heavy = np.flatnonzero(model.body_mass > 0.0)
    axes = data.xmat.reshape(-1, 3, 3).copy()
    inertias = {i: (r := data.ximat[i].reshape(3, 3)) @ np.diag(model.body_inertia[i]) @ r.T for i in heavy}
    centres, masses = data.xipos.copy(), model.body_mass.copy()
    for i in heavy:
        gaps = np.linalg.norm(centres[heavy] - FLIP @ centres[i], axis=1) + np.abs(masses[heavy] - masses[i])
        k = heavy[gaps.argmin()]
        model.body_mass[i] = 0.5 * (masses[i] + masses[k])
        model.body_ipos[i] = axes[i].T @ (0.5 * (centres[i] + FLIP @ centres[k]) - data.xpos[i])
        own = axes[i].T @ (0.5 * (inertias[i] + FLIP @ inertias[k] @ FLIP)) @ axes[i]
        values, vectors = np.linalg.eigh(own)
        vectors[:, 2] *= np.linalg.det(vectors)
        model.body_inertia[i] = values
        mujoco.mju_mat2Quat(model.body_iquat[i], vectors.ravel())
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 100, 0.0
    mujoco.mj_setConst(model, data)
    return model


@pytest.mark.quick("go1_velocity", "g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_mirrored_states_and_actions_give_mirrored_next_states(task: str) -> None:
    made = bound(task)
    p = SimpleNamespace(**made.params)
    mirror, home = walkers.mirror(made.model, p), walkers.home_qpos(made.model)

    def image(name: str, row: np.ndarray) -> np.ndarray:
        order, signs = mirror.parts[name]
        return np.array(signs) * row[order]

    model, random, contacts = symmetric(made.model, mirror), np.random.default_rng(0), 0
    tolerance = 1e-4 if task.startswith("g1") else 1e-8  # the shoulders of the G1 are asymmetric by 0.01 mm
    for _ in range(5):
        qpos, qvel = home.copy(), 0.5 * random.normal(size=model.nv)
        qpos[1], qpos[3:7] = 0.3, np.array([1.0, *0.05 * random.normal(size=3)])
        qpos[3:7] /= np.linalg.norm(qpos[3:7])
        qpos[7:] += random.uniform(-0.1, 0.1, model.nq - 7)
        action, states = random.normal(size=len(p.joints)), []
        for own in (lambda name, row: row, image):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = own("qpos", qpos), own("qvel", qvel)
            data.ctrl[:] = home[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
            data.ctrl[p.controls] = p.default_pose + p.action_scale * own("last_action", action)
            mujoco.mj_step(model, data, 4)
            states.append((data.qpos.copy(), data.qvel.copy()))
            contacts += data.ncon
        (qpos_after, qvel_after), (other_qpos, other_qvel) = states
        np.testing.assert_allclose(image("qpos", qpos_after), other_qpos, atol=tolerance)
        np.testing.assert_allclose(image("qvel", qvel_after), other_qvel, atol=100 * tolerance)
        assert np.abs(qvel_after - qvel).max() > 1.0
    assert contacts > 0


MEMORY = {
    "drawn_velocity": "command", "sensordata": "foot_force", "encoder_bias": "joint_position",
    **dict.fromkeys(("contact_time", "air_time", "swing_height", "peak_height"), "foot_height"),
    **{name: name for name in ("qpos", "qvel", "last_action", "clock")}, "previous_action": "last_action",
}  # fmt: skip


@pytest.mark.quick("go1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_observations_of_mirrored_states_are_mirrored(task: str, shared_env: SharedEnv) -> None:
    bound(task)
    noises = ("linear_velocity", "angular_velocity", "gravity", "joint_position", "joint_velocity")
    own = {f"{name}_noise": 0.0 for name in noises} | {"push_seconds": (1e6, 1e6)}
    if task == "go1_velocity":
        own["imu"] = (0.01, 0.0, 0.02)  # put the velocimeter into the plane of symmetry
    env = shared_env(task, nworld=16, **own)
    mirror = walkers.mirror(env.model, SimpleNamespace(**env.task.params))
    for _ in range(15):
        env.step(0.5 * torch.randn(env.action.shape, generator=torch.Generator().manual_seed(env.nworld)))
    obs, state = {name: rows.clone() for name, rows in env.obs_groups.items()}, env.get_state()
    parts = env.state_space.split(state)
    for name in MEMORY.keys() & parts.keys():
        order, signs = mirror.parts[MEMORY[name]]
        parts[name].copy_(parts[name][:, order] * torch.tensor(signs))
    parts["heading_target"] *= -1.0
    for group, rows in obs.items():
        image = Reflected(reflections(env, group=group)["obs"])(rows)
        torch.testing.assert_close(env.get_obs(state, group=group), image, atol=2e-5, rtol=1e-4)
        assert (image - rows).abs().mean() > 0.05


def test_height_scan_of_the_ground_is_mirrored() -> None:
    made = bound("go1_rough_velocity")
    p = SimpleNamespace(**made.params)
    order, signs = walkers.mirror(made.model, p).parts["height_scan"]
    np.testing.assert_allclose(np.asarray(p.scan)[order] * [1.0, -1.0], p.scan, atol=1e-6)
    assert set(signs) == {1.0}


def test_robot_without_a_mirror_image_raises_an_error() -> None:
    made = bound("go1_velocity")
    p = SimpleNamespace(**made.params)
    p.joints = p.joints[:3]
    with pytest.raises(ValueError, match="the joint 'FR_hip' is actuated, but its mirror image 'FL_hip' is not"):
        walkers.mirror(made.model, p)
    p.joints, p.default_pose = made.params["joints"], np.arange(12.0)
    with pytest.raises(ValueError, match="default_pose is not symmetric"):
        walkers.mirror(made.model, p)
    model = copy.copy(made.model)
    model.body_pos[model.body("FR_thigh").id, 1] += 0.1
    with pytest.raises(ValueError, match="the joint 'FR_thigh' has no mirror image"):
        walkers.mirror(model, p)
