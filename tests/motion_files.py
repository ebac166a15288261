"""Write a Go1 clip of the package in the formats of other projects."""

import pickle
from pathlib import Path

import mujoco
import numpy as np

import lyceum_warp as lw
from lyceum_warp.motions import kinematics

TASKS = Path(lw.__file__).parent / "tasks"


def go1() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(TASKS / "velocity/go1.xml"))


def go1_clip(clip: int = 0) -> np.ndarray:
    table = np.load(TASKS / "tracking/go1.npy")
    first, count = kinematics.ranges(table)[clip]
    return table[first : first + count, 2:].astype(float)


def write_npz(path: Path, model: mujoco.MjModel, qpos: np.ndarray, rate: float, **more: np.ndarray) -> Path:
    """Write BeyondMimic's format."""
    qvel, positions, rotations, velocities, spins = kinematics.reference_of(model, qpos, 1.0 / rate)
    arrays = {
        "fps": np.array([rate]), "joint_pos": qpos[:, 7:], "joint_vel": qvel[:, 6:], "body_pos_w": positions[:, 1:],
        "body_quat_w": rotations[:, 1:], "body_lin_vel_w": velocities[:, 1:], "body_ang_vel_w": spins[:, 1:],
    }  # fmt: skip
    np.savez(path, **arrays | more)
    return path


def write_csv(path: Path, qpos: np.ndarray) -> Path:
    """Write Unitree's format."""
    np.savetxt(path, qpos[:, [0, 1, 2, 4, 5, 6, 3, *range(7, qpos.shape[1])]], delimiter=",")
    return path


def write_pickle(path: Path, qpos: np.ndarray, rate: float, protocol: int = 4) -> Path:
    """Write GMR's format."""
    content = {
        "fps": rate, "root_pos": qpos[:, :3], "root_rot": qpos[:, [4, 5, 6, 3]],
        "dof_pos": np.asfortranarray(qpos[:, 7:]), "local_body_pos": None, "link_body_list": None,
    }  # fmt: skip
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path
