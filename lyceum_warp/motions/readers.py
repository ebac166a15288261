"""Read motions from files of several formats, without running code from the files."""

import dataclasses
import io
import json
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.support.validate import first_sentence

_CSV_RATE = 30.0
"""Frames per second of Unitree's CSV files, which do not store it."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A motion as a file stores it."""

    qpos: np.ndarray
    """Position (m) and rotation (w, x, y, z) of the base, and positions of the joints (rad), (frames, 7 + joints)."""
    rate: float
    """Frames per second."""
    joints: list[str] | None = None
    """Names of the joints, if the file stores them."""
    body_positions: np.ndarray | None = None
    """Stored positions of the robot's bodies, (frames, bodies, 3), in m."""
    bodies: list[str] | None = None
    """Names of these bodies, if the file stores them."""


def read_motion(path: Path) -> Motion:
    """Read a file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file has another format, or is broken.
    """
    if path.suffix not in READERS:
        raise ValueError(f"{path} is not a motion: its name must end in {', '.join(READERS)}")
    try:
        motion = READERS[path.suffix](path)
        _check(motion)
    except Exception as error:  # the readers raise many types of errors
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise ValueError(f"{path} is broken, or is not a motion ({first_sentence(error)})") from error
    return motion


def _check(motion: Motion) -> None:
    qpos, rate = motion.qpos, motion.rate
    if qpos.ndim != 2 or len(qpos) < 3 or qpos.shape[1] < 8:
        raise ValueError(f"it has the shape {qpos.shape}, but needs three frames of a base and at least one joint")
    if not 1.0 <= rate <= 10000.0:
        raise ValueError(f"it has {rate:g} frames per second")
    if not (np.abs(qpos) < 1e6).all():
        raise ValueError("it has a coordinate that is not finite or absurd")
    if (norms := np.abs(np.linalg.norm(qpos[:, 3:7], axis=1) - 1.0)).max() > 1e-2:
        raise ValueError(f"the base's rotation in frame {norms.argmax()} is no unit quaternion")
    if motion.joints is not None and len(motion.joints) != qpos.shape[1] - 7:
        raise ValueError(f"it has {qpos.shape[1] - 7} joints, but {len(motion.joints)} names of joints")
    stored = motion.body_positions
    if stored is not None and (stored.shape[::2] != (len(qpos), 3) or not (np.abs(stored) < 1e6).all()):
        raise ValueError(f"the bodies' positions have the shape {stored.shape}, or are not finite")


def _read_npz(path: Path) -> Motion:
    """Read an episode of this package, or a motion in BeyondMimic's format, with or without names."""
    with np.load(path, allow_pickle=False) as file:
        if "states" in file:
            info = json.loads(str(file["info"]))
            start, stop = info["state_parts"]["qpos"]
            qpos = np.asarray(file["states"], float)[:, start:stop]
            qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)  # as MuJoCo reads rotations
            return Motion(qpos, 1.0 / float(info["timestep"]))
        joints, bodies = ([str(name) for name in file[names]] if names in file else None
                          for names in ("joint_names", "body_names"))  # fmt: skip
        positions, qpos = np.asarray(file["body_pos_w"], float), np.asarray(file["joint_pos"], float)
        if joints is None or qpos.shape[1] == len(joints):  # holosoma's files have the base's pose here, too
            qpos = np.hstack([positions[:, 0], np.asarray(file["body_quat_w"], float)[:, 0], qpos])
        return Motion(qpos, float(np.ravel(file["fps"])[0]), joints, positions, bodies)


def _read_csv(path: Path) -> Motion:
    """Read Unitree's format: in each row the base's position, its rotation (x, y, z, w), and the joints."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8")
    return Motion(rows[:, [0, 1, 2, 6, 3, 4, 5, *range(7, rows.shape[1])]], _CSV_RATE)


def _read_pickle(path: Path) -> Motion:
    """Read GMR's format, a dict with fps, root_pos, root_rot (x, y, z, w) and dof_pos."""
    # the optimizer numbers the memo anew: an index in a broken file could make the unpickler allocate any memory
    content = _Unpickler(io.BytesIO(pickletools.optimize(path.read_bytes()))).load()
    position, rotation, joints = (np.asarray(content[name], float) for name in ("root_pos", "root_rot", "dof_pos"))
    return Motion(np.hstack([position, rotation[:, [3, 0, 1, 2]], joints]), float(np.asarray(content["fps"], float)))


READERS: dict[str, Callable[[Path], Motion]] = {".npz": _read_npz, ".csv": _read_csv, ".pkl": _read_pickle}
"""The reader of each kind of files."""


# pickles


def _dtype(text: str, *flags: bool) -> np.dtype:
    """Return a numeric dtype of NumPy itself, which ignores the state that follows in a pickle."""
    dtype = np.dtype(np.dtype(text).type)
    if dtype.kind not in "fiub":
        raise pickle.UnpicklingError(f"it has an array of {dtype}")
    return dtype


_MAKERS: dict[str, Any] = {
    "ndarray": None, "dtype": _dtype,
    "_reconstruct": lambda *_: np.zeros(0),  # its shape, dtype and content follow in the pickle
    "_frombuffer": lambda content, dtype, shape, order: np.frombuffer(content, dtype).reshape(shape, order=order),
    "scalar": lambda dtype, content: np.frombuffer(content, dtype)[0],
}  # fmt: skip
"""What stands for each name of NumPy in a pickle. All other names are refused."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in _MAKERS:
            return _MAKERS[name]
        if (module, name) == ("_codecs", "encode"):  # before protocol 3, pickles hold bytes as texts
            return lambda text, encoding: str.encode(text, "latin1")
        raise pickle.UnpicklingError(f"it would run {module}.{name}, but only arrays are read")
