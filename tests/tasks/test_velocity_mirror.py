import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

from lyceum_warp import walkers
from lyceum_warp.algos.common.symmetry import Reflected, reflections
from lyceum_warp.binding import find_task, task_names
from lyceum_warp.binding.bound_task import BoundTask

ROBOTS = [task for task in task_names() if task.endswith("_velocity") and "rough" not in task]
FLIP = np.array([1.0, -1.0, 1.0])


@pytest.mark.quick("go1_velocity", "g1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_mirrored_coordinates_velocities_and_actions_give_the_mirror_image_of_the_robot(task: str) -> None:
    made = BoundTask(find_task(task))
    model, p, rng = made.model, SimpleNamespace(**made.params), np.random.default_rng(0)
    mirror = walkers.mirror(model, p)

    def image(name: str, row: np.ndarray) -> np.ndarray:
        order, signs = mirror.parts[name]
        return np.array(signs) * row[order]

    partners, feet = np.array(mirror.parts["qvel"][0][6:]) - 6, mirror.parts["foot_height"][0]
    for _ in range(5):
        qpos, qvel = walkers.home_qpos(model) + 0.1 * rng.normal(size=model.nq), rng.normal(size=model.nv)
        action, images = rng.normal(size=len(p.joints)), []
        for own in (lambda name, row: row, image):
            data = mujoco.MjData(model)
            data.qpos[:] = own("qpos", qpos)
            data.qpos[p.joint_qpos] += p.action_scale * own("last_action", action)
            mujoco.mj_integratePos(model, data.qpos, own("qvel", qvel), 0.2)
            mujoco.mj_kinematics(model, data)
            images.append((data.xanchor[1:], data.xaxis[1:], data.site_xpos[p.feet]))
        (anchors, axes, sites), (other_anchors, other_axes, other_sites) = images
        np.testing.assert_allclose(other_anchors, FLIP * anchors[partners], atol=1e-3)
        np.testing.assert_allclose(np.abs(other_axes), np.abs(axes[partners]), atol=1e-3)
        np.testing.assert_allclose(other_sites, FLIP * sites[feet], atol=1e-3)


MEMORY = {
    "drawn_velocity": "command", "sensordata": "foot_force", "encoder_bias": "joint_position",
    **dict.fromkeys(("contact_time", "air_time", "swing_height", "peak_height"), "foot_height"),
    **{name: name for name in ("qpos", "qvel", "last_action", "clock")}, "previous_action": "last_action",
}  # fmt: skip


@pytest.mark.quick("go1_velocity")
@pytest.mark.parametrize("task", ROBOTS)
def test_observations_of_mirrored_states_are_mirrored(task: str, shared_env: SharedEnv) -> None:
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
    made = BoundTask(find_task("go1_rough_velocity"))
    p = SimpleNamespace(**made.params)
    order, signs = walkers.mirror(made.model, p).parts["height_scan"]
    np.testing.assert_allclose(np.asarray(p.scan)[order] * [1.0, -1.0], p.scan, atol=1e-6)
    assert set(signs) == {1.0}


def test_robot_without_a_mirror_image_raises_an_error() -> None:
    made = BoundTask(find_task("go1_velocity"))
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
