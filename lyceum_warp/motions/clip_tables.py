"""Compute the tables of a tracking task from its clips. All functions are for ``lw.from_model``.

The parameter ``p.clips`` is the table of a ``Clips``. The parameter ``p.bodies`` lists the tracked bodies.
"""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.models import walkers
from lyceum_warp.motions import kinematics

BINS = (256, 2048)
"""Numbers of bins. Kernels are compiled for a number of bins, so few numbers mean few compilations. With more bins, the
sums over all worlds would take a noticeable part of a step."""


def standing(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Make a clip of one second in which the robot stands in its default pose."""
    times, qpos = np.arange(round(1.0 / p.dt) + 1)[:, None] * p.dt, walkers.home_qpos(model).copy()
    qpos[p.joint_qpos] = p.default_pose
    return np.hstack([times, np.ones_like(times), np.tile(qpos, (len(times), 1))])


def ranges(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the first row and the number of rows of each clip, (clips, 2).

    Raises:
        ValueError: The clips are those of a robot with other joints, have another rate than the task, or are broken.
    """
    joints = p.clips.shape[1] - 9
    if model.nq != joints + 7:
        raise ValueError(f"the clips have {joints} joints and a base, but the model has {model.nq} coordinates")
    table = kinematics.ranges(p.clips)
    is_unit = np.abs(np.linalg.norm(p.clips[:, 5:9], axis=1) - 1.0) < 1e-2
    if p.clips[0, 0] or table[:, 1].min() < 3 or not is_unit.all() or not (p.clips[:, 1] > 0.0).all():
        raise ValueError(
            "each clip needs three rows, and each row a time from 0 on, a positive weight, a position and a unit "
            "quaternion: make clips by lw.load_clips"
        )
    if (clip := np.max(p.start_clip)) >= len(table):
        raise ValueError(f"start_clip={clip:g} must be less than {len(table)}, the number of clips")
    last = p.clips[table.sum(1) - 1, 0]
    dt = float(last.sum() / (table[:, 1] - 1).sum())
    if abs(dt / p.dt - 1.0) > 1e-3:
        raise ValueError(
            f"the clips have {1.0 / dt:.6g} frames per second, but a step lasts {p.dt:g} s: load them with "
            f"rate={1.0 / p.dt:g}"
        )
    return table


def reference(part: str) -> Callable[[mujoco.MjModel, Any], np.ndarray]:
    """Get a part of ``kinematics.Reference`` of all clips for the tracked bodies, (frames, ...)."""
    return lambda model, p: getattr(kinematics.references(model, p.clips, p.bodies, p.dt), part)


def bins(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Divide each clip into parts of about ``p.bin_seconds``: the clip, the first row and the number of rows.

    The result is (bins, 3), with a number of bins in ``BINS``. Bins that are not needed are empty, and begin after the
    last row. No bin contains the last frame of a clip, where no episode can begin.
    """
    starts = p.ranges[:, 1] - 1
    size = max(1.0, float(np.max(p.bin_seconds)) / p.dt, starts.sum() / max(1, BINS[-1] - len(starts)))
    rows = []
    for clip, (first, count) in enumerate(p.ranges):
        edges = np.linspace(0, count - 1, max(1, round((count - 1) / size)) + 1).round().astype(int)
        rows += [(clip, first + low, high - low) for low, high in itertools.pairwise(edges)]
    number = next((number for number in BINS if number >= len(rows)), 0)
    if not number:
        raise ValueError(f"there are {len(p.ranges)} clips, but at most {BINS[-1]} are possible")
    return np.array(rows + (number - len(rows)) * [(0, len(p.clips), 0)])


def bin_ends(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the last row that belongs to each bin, (bins,). The last row of a clip belongs to the clip's last bin."""
    return np.append(p.bins[1:, 1], len(p.clips)) - 1


def bin_starts(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the probability that an episode begins in a bin or in an earlier one if no episode fails, (bins,).

    The probability of a bin is proportional to its length and to the clip's weight.
    """
    shares = np.cumsum(p.bins[:, 2] * p.clips[p.ranges[p.bins[:, 0], 0], 1], dtype=float)
    return shares / shares[-1]
