"""Compare stored bodies with a model, and report what a robot cannot do: sinking, slipping, joints beyond limits."""

import mujoco
import numpy as np

from lyceum_warp.motions.kinematics import Reference, contact_spheres
from lyceum_warp.motions.rotations import rotate

_SAME = 0.02
"""Distance in m below which a stored body is where the model puts it. Revisions of the G1 differ by 1 cm."""

_SINK = 0.02
"""Depth in m below the ground that is reported."""
_SLIP = 0.3
"""Mean speed of contacts in m/s that is reported."""
_CONTACT = 0.01
"""Height in m below which a point is in contact."""
_BEYOND = 0.02
"""Distance in rad beyond a joint's limit that is reported."""


def check_bodies(model: mujoco.MjModel, stored: np.ndarray, positions: np.ndarray, names: list[str] | None) -> None:
    """Compare stored positions of bodies (frames, bodies, 3) with those of all the model's bodies.

    Raises:
        ValueError: The file belongs to another robot, or has another order of joints or bodies.
    """
    all_names = [model.body(body).name for body in range(model.nbody)]
    bodies = range(1, model.nbody) if names is None else [all_names.index(name) for name in names if name in all_names]
    if stored.shape[1] != len(bodies):
        strange = sorted(set(names or ()) - set(all_names))
        what = f", such as {', '.join(strange[:3])}" if strange else ""
        raise ValueError(f"it has {stored.shape[1]} bodies{what}, but the model has {model.nbody - 1}: another robot?")
    ours = positions[:, list(bodies)]
    errors = np.linalg.norm(stored - ours, axis=2).max(0)
    if errors.max() <= _SAME:
        return
    distances = np.linalg.norm(stored[:, :, None] - ours[:, None], axis=3).max(0)
    nearest = distances.argmin(1)
    texts = []
    for i in np.argsort(-errors)[:4]:
        name, other = all_names[bodies[i]], all_names[bodies[nearest[i]]]
        place = (
            f"is where the model has {other}" if distances[i, nearest[i]] <= _SAME else f"is off by {errors[i]:.2g} m"
        )
        texts.append(f"{name} {place}")
    raise ValueError(
        f"its bodies are not those of the model: {', '.join(texts)}; the file has another order of bodies or joints, "
        "or belongs to another robot"
    )


def findings(model: mujoco.MjModel, qpos: np.ndarray, reference: Reference, rate: float) -> list[str]:
    """Describe in short texts what the robot cannot do in a motion.

    Args:
        model: The robot on a ground at height 0.
        qpos: The coordinates, (frames, nq).
        reference: The poses of all bodies, from ``reference_of``.
        rate: Frames per second.
    """
    texts = []
    bodies, spheres = contact_spheres(model)
    points = reference.positions[:, bodies] + rotate(reference.rotations[:, bodies], spheres[:, :3])
    heights = points[..., 2] - spheres[:, 3]
    if heights.size and (depth := -heights.min()) > _SINK:
        frame, sphere = np.unravel_index(heights.argmin(), heights.shape)
        name = model.body(bodies[sphere]).name
        texts.append(f"{name} sinks {100 * depth:.0f} cm into the ground at {frame / rate:.2f} s")
    touching = (heights[1:] < _CONTACT) & (heights[:-1] < _CONTACT)
    speeds = np.linalg.norm(np.diff(points[..., :2], axis=0), axis=2) * rate
    if touching.any() and (slip := speeds[touching].mean()) > _SLIP:
        texts.append(f"its contacts slip at {slip:.2f} m/s on average")
    hinges = np.flatnonzero(model.jnt_limited)
    values, limits = qpos[:, model.jnt_qposadr[hinges]], model.jnt_range[hinges]
    beyond = np.maximum(limits[:, 0] - values, values - limits[:, 1]).max(0)
    for i in np.argsort(-beyond)[:3]:
        if beyond[i] > _BEYOND:
            texts.append(f"{model.joint(hinges[i]).name} is {beyond[i]:.2g} rad beyond its limit")
    return texts
