"""Load the models of dm_control's suite, and define functions that several domains use."""

from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


def model(domain: str) -> lw.ModelFile:
    """Load a domain's model from the package dm-control."""
    file = f"suite/{domain}.xml"
    return lw.package_model("dm_control", file, install="lyceum-warp[dm-control]", before_python="3.13")


def free_target(spec: mujoco.MjSpec) -> None:
    """Move the geom or site "target" into a mocap body, so that its position is part of the state."""
    fixed = spec.geom("target") or spec.site("target")
    target = spec.worldbody.add_body(name="target", mocap=True, pos=fixed.pos)
    looks = {"name": "target", "type": fixed.type, "size": fixed.size.copy(), "material": fixed.material}
    add = target.add_geom if isinstance(fixed, mujoco.MjsGeom) else target.add_site
    spec.delete(fixed)
    add(**looks)


def count_contacts(spec: mujoco.MjSpec) -> None:
    number = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
    spec.add_sensor(name="contacts", type=mujoco.mjtSensor.mjSENS_CONTACT, intprm=[number, 0, 1])


def random_joints(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the ``qpos`` indices of the joints that start at random positions: hinges, and joints with limits."""
    drawn = model.jnt_limited.astype(bool) | (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    return model.jnt_qposadr[drawn]


def random_range(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the ranges of the joints in ``p.drawn_joints``, (joints, 2), or +-pi for a hinge without limits."""
    joints = np.searchsorted(model.jnt_qposadr, p.drawn_joints)
    return np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.pi, np.pi])


@wp.struct
class RandomJoints:
    """The parameters of ``draw_joints``."""

    drawn_joints: wp.array[int] = lw.from_model(random_joints)  # indices in qpos of the joints that each episode draws
    drawn_range: wp.array[wp.vec2] = lw.from_model(random_range)  # their ranges, m or rad


@wp.func
def draw_joints(qpos: Row[float], drawn_joints: Row[int], drawn_range: Row[wp.vec2], rng: Row[wp.uint32]):
    """Draw positions of joints, as dm_control's randomize_limited_and_rotational_joints does."""
    for j in range(drawn_joints.shape[0]):
        qpos[drawn_joints[j]] = lw.uniform(rng, drawn_range[j][0], drawn_range[j][1])


@wp.func
def small_control(action: Row[float]) -> float:
    """(4 + mean(max(0, 1 - a^2))) / 5."""
    total = float(0.0)
    for i in range(action.shape[0]):
        total += lw.tolerance(action[i], wp.vec2(0.0), 1.0, lw.Sigmoid.QUADRATIC, 0.0)
    return (4.0 + total / float(action.shape[0])) / 5.0


@wp.func
def log1p(x: float) -> float:
    """Return log(1 + x), by which dm_control scales touch sensors."""
    return wp.log(1.0 + x)
