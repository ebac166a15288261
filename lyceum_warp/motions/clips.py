"""Load reference motions, cut, loop and join them, and put them into one table."""

import dataclasses
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.motions import checks, kinematics, rotations
from lyceum_warp.motions.readers import READERS, Motion, read_motion
from lyceum_warp.support.files import replaced
from lyceum_warp.support.machine import free_memory
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import finite_number, positive_number, whole_number
from lyceum_warp.support.warp_log import start_warp

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Clips:
    """Reference motions of one robot at one rate, for the parameter ``clips`` of a tracking task.

    ``clips["walk"]`` or ``clips[0]`` selects a clip, and ``clips + others`` adds more clips. NumPy converts clips to
    one table, as in ``np.save("clips.npy", clips)``. The table has a row for each frame: the time since the first frame
    of its clip in s, the clip's weight, and the coordinates.
    """

    names: tuple[str, ...]
    """The names of the clips."""
    qpos: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    """The coordinates in each frame of each clip, (frames, nq): position (m) and rotation (w, x, y, z) of the base, and
    positions of the joints (rad)."""
    rate: float
    """Frames per second."""
    weights: tuple[float, ...]
    """How much more often than others each clip is drawn, per second of its length."""

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator["Clips"]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, clip: int | str) -> "Clips":
        if isinstance(clip, str):
            if clip not in self.names:
                hint = did_you_mean(clip, self.names, f"there are {', '.join(self.names)}")
                raise KeyError(f"there is no clip {clip!r}: {hint}")
            clip = self.names.index(clip)
        return dataclasses.replace(
            self, names=(self.names[clip],), qpos=(self.qpos[clip],), weights=(self.weights[clip],)
        )

    def __add__(self, other: "Clips") -> "Clips":
        if (other.rate, other.qpos[0].shape[1]) != (self.rate, self.qpos[0].shape[1]):
            raise ValueError(
                "clips that are added must have the same rate and the same robot: load them with one model"
            )
        names, weights = self.names + other.names, self.weights + other.weights
        return dataclasses.replace(self, names=names, qpos=self.qpos + other.qpos, weights=weights)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        rows = [
            np.column_stack([np.arange(len(qpos)) / self.rate, np.full(len(qpos), weight), qpos])
            for qpos, weight in zip(self.qpos, self.weights, strict=True)
        ]
        return np.concatenate(rows).astype(np.float32 if dtype is None else dtype)

    @property
    def seconds(self) -> float:
        """The duration of all clips together."""
        return sum(len(qpos) - 1 for qpos in self.qpos) / self.rate

    def cut(self, start: float, end: float) -> "Clips":
        """Keep a part of each clip, from ``start`` to ``end`` seconds after its first frame.

        Raises:
            ValueError: A clip has no such part.
        """
        first, last = round(finite_number("start", start) * self.rate), round(finite_number("end", end) * self.rate)
        for name, qpos in zip(self.names, self.qpos, strict=True):
            if not 0 <= first <= last - 2 < len(qpos) - 2:
                seconds = (len(qpos) - 1) / self.rate
                raise ValueError(f"{name} has no part from {start:g} to {end:g} s: it lasts {seconds:.6g} s")
        return dataclasses.replace(self, qpos=tuple(qpos[first : last + 1] for qpos in self.qpos))

    def join(self, *, blend: float = 0.2) -> "Clips":
        """Join all clips into one, in order.

        Each clip is moved and turned about the vertical, so that it begins where the one before it ends. ``blend`` is
        the number of seconds in between, in which the pose changes steadily and the base keeps its speed.
        """
        qpos = _joined(self.qpos, self.rate, blend)
        return dataclasses.replace(self, names=self.names[:1], qpos=(qpos,), weights=self.weights[:1])

    def loop(self, times: int, *, blend: float = 0.2) -> "Clips":
        """Repeat each clip, joined as by ``join``."""
        times = whole_number("times", times, low=1)
        return dataclasses.replace(self, qpos=tuple(_joined(times * [qpos], self.rate, blend) for qpos in self.qpos))

    def save(self, path: str | Path, model: mujoco.MjModel) -> Path:
        """Write one clip in BeyondMimic's format, with the names of joints and bodies, and return the path.

        The npz file has joint positions and velocities, (frames, joints), and the bodies' positions, rotations (w, x,
        y, z), velocities and angular velocities in the world's axes, (frames, bodies, ...).

        Raises:
            ValueError: There is more than one clip.
        """
        if len(self) != 1:
            raise ValueError(f"a file has one clip, not {len(self)}: select one, as clips[0].save(...)")
        qpos, names = self.qpos[0], ("joint_names", "body_names")
        qvel, *poses = kinematics.reference_of(model, qpos, 1.0 / self.rate)
        parts = ("body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
        elements = (
            (model.joint(i).name for i in range(1, model.njnt)),
            (model.body(i).name for i in range(1, model.nbody)),
        )
        content = {"fps": np.array([self.rate]), "joint_pos": qpos[:, 7:], "joint_vel": qvel[:, 6:]}
        content |= {part: pose[:, 1:].astype(np.float32) for part, pose in zip(parts, poses, strict=True)}
        content |= {kind: np.array(list(each)) for kind, each in zip(names, elements, strict=True)}
        with replaced(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, **content)  # type: ignore[arg-type]
        return Path(path)


def load_clips(
    paths: str | Path | Iterable[str | Path] | Mapping[str | Path, float],
    model: mujoco.MjModel,
    *,
    rate: float = 50.0,
    device: str = "cpu",
) -> Clips:
    """Load reference motions from files, and check them against a robot's model.

    ==========  ==============================================================================================
    ``.npz``    BeyondMimic's format, with or without ``joint_names`` and ``body_names``; or an episode of this
                package (``Trajectory.save``, ``lyceum-warp eval --episodes-to``)
    ``.csv``    Unitree's format at 30 frames per second: the base's position and rotation (x, y, z, w), joints
    ``.pkl``    GMR's format; the file's code is not run
    ==========  ==============================================================================================

    Motions are resampled linearly, and rotations at constant speed (slerp). Positions of bodies that a file stores are
    only compared with the model's kinematics. Warnings in the log name contacts that slip or sink and joints beyond
    their limits.

    Args:
        paths: Files or folders, or a dict of these and their weights (see ``Clips.weights``). From a folder, all
            motions are loaded in alphabetical order.
        model: The robot on flat ground, such as ``lw.make("g1_tracking").model``. Its first joint must be free, and
            all others must be hinges or slides.
        rate: Frames per second of the result, one per step of the task.
        device: The device on which the task's tables must fit into the free memory.

    Raises:
        FileNotFoundError: A file does not exist, or a folder has no motion.
        ValueError: A file is broken, belongs to another robot or has another order of bodies, or the clips do not fit
            into the memory.
    """
    rate = positive_number("rate", rate, "frames per second")
    if model.nq != model.njnt + 6 or model.nv != model.njnt + 5 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError("clips need a model whose first joint is free, and whose other joints are hinges or slides")
    listed = (
        paths if isinstance(paths, Mapping) else dict.fromkeys([paths] if isinstance(paths, str | Path) else paths, 1)
    )
    weights = {file: positive_number(f"the weight of {path}", weight, "draws per second") for path, weight in
               listed.items() for file in _files(Path(path))}  # fmt: skip
    if not weights:
        raise ValueError("there is no motion to load: name at least one file")
    start_warp()
    room, frame = free_memory(wp.get_device(device)), 4 * (2 + model.nq + model.nv + 13 * model.nbody)
    qpos, rows = list[np.ndarray](), 0
    for file in weights:
        motion = read_motion(file)
        rows += round((len(motion.qpos) - 1) / motion.rate * rate) + 1
        if room is not None and rows * frame > 0.5 * room:
            raise ValueError(
                f"the clips up to {file} take {rows * frame / 1e9:.3g} GB in the tables of a task, and {device} has "
                f"{room / 1e9:.3g} GB free: load fewer or shorter clips"
            )
        try:
            qpos.append(_fitted(motion, model, rate, file.name))
        except ValueError as error:
            raise ValueError(f"{file} does not fit the model: {error}") from error
    return Clips(
        names=tuple(file.stem for file in weights), qpos=tuple(qpos), rate=rate, weights=tuple(weights.values())
    )


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix in READERS)
    if not files:
        raise FileNotFoundError(f"there is no motion in the folder {path}: it has no {' or '.join(READERS)} file")
    return files


def _fitted(motion: Motion, model: mujoco.MjModel, rate: float, name: str) -> np.ndarray:
    """Put the coordinates into the order of the model, check them, and resample them."""
    qpos, names = motion.qpos, [model.joint(joint).name for joint in range(1, model.njnt)]
    if motion.joints is not None:
        if missing := [joint for joint in names if joint not in motion.joints]:
            raise ValueError(f"it has no joint {missing[0]!r}, but {', '.join(motion.joints)}")
        qpos = qpos[:, [*range(7), *(7 + motion.joints.index(joint) for joint in names)]]
    if qpos.shape[1] != model.nq:
        raise ValueError(f"it has {qpos.shape[1] - 7} joints, but the model has {len(names)}: another robot?")
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    if motion.body_positions is not None:
        # a wrong order shows in every frame
        frames = np.unique(np.linspace(0, len(qpos) - 1, 20).astype(int))
        positions = kinematics.reference_of(model, qpos[frames], 1.0).positions
        checks.check_bodies(model, motion.body_positions[frames], positions, motion.bodies)
    if (seconds := (len(qpos) - 1) / motion.rate) * rate < 2.0:
        raise ValueError(f"it lasts only {seconds:.2g} s")
    qpos = _resampled(qpos, motion.rate, rate)
    for text in checks.findings(model, qpos, kinematics.reference_of(model, qpos, 1.0 / rate), rate):
        log.warning("%s: %s", name, text)
    return qpos


def _resampled(qpos: np.ndarray, source: float, rate: float) -> np.ndarray:
    """Interpolate coordinates linearly, and the base's rotation by slerp."""
    count = int((len(qpos) - 1) / source * rate + 1e-6) + 1
    places = np.minimum(np.arange(count) * (source / rate), len(qpos) - 1.0)
    low = np.minimum(places.astype(int), len(qpos) - 2)
    a, b, share = qpos[low], qpos[low + 1], places - low
    between = a + share[:, None] * (b - a)
    between[:, 3:7] = rotations.interpolate(a[:, 3:7], b[:, 3:7], share)
    return between


def _joined(motions: Sequence[np.ndarray], rate: float, blend: float) -> np.ndarray:
    a, count = motions[0], max(1, round(positive_number("blend", blend, "seconds") * rate))
    for b in motions[1:]:
        turns = rotations.yaw(a[-2:, 3:7]), rotations.yaw(b[:2, 3:7])
        # the base moves on at the mean of its two speeds
        drift = 0.5 * count * np.diff(np.unwrap(turns, axis=1), axis=1).sum()
        turn = rotations.from_rotvec(np.array([0.0, 0.0, turns[0][1] - turns[1][0] + drift]))
        other = b.copy()
        other[:, 3:7] = rotations.multiply(np.broadcast_to(turn, (len(b), 4)), b[:, 3:7])
        other[:, :3] = rotations.rotate(turn, b[:, :3])
        step = 0.5 * (a[-1, :2] - a[-2, :2] + other[1, :2] - other[0, :2])
        other[:, :2] += a[-1, :2] + count * step - other[0, :2]
        between = _resampled(np.stack([a[-1], other[0]]), rate / count, rate)
        a = np.concatenate([a, between[1:-1], other])
    return a
