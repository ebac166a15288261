"""Push the body that the mouse drags, or move it while paused."""

import threading
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.viewer.protocol import Perturb


class Mouse:
    """Converts drags of the selected body to commands."""

    def __init__(self, do: Callable[[Perturb], None]) -> None:
        self._do = do
        self._pushed: Perturb | None = None
        self._left = False
        self._lock = threading.Lock()

    def drag(self, viewer: Any, *, paused: bool) -> None:
        """Push the selected body while the mouse drags it. If the session is paused, move it instead."""
        with self._lock:
            if self._left:
                self._left = False
                viewer.perturb.active = 0
            if viewer.perturb.active and viewer.perturb.select > 0:
                push = _perturbation(viewer.model, viewer.data, viewer.perturb, paused)
                if self._pushed is None or _rounded(push) != _rounded(self._pushed):
                    self._pushed = push
                    self._do(push)
            else:
                self._end()

    def let_go(self) -> None:
        """End a push after the browser has disconnected. Any thread may call this method."""
        with self._lock:
            self._left = True  # without a browser, studio does not notice the release of the button
            self._end()

    def _end(self) -> None:
        if self._pushed is not None:
            forces, self._pushed = np.zeros_like(self._pushed.forces), None
            self._do(Perturb(forces=forces))


def _perturbation(model: mujoco.MjModel, data: mujoco.MjData, perturb: mujoco.MjvPerturb, paused: bool) -> Perturb:
    data.xfrc_applied[:] = 0
    mujoco.mjv_applyPerturbPose(model, data, perturb, int(paused))
    if not paused:
        mujoco.mjv_applyPerturbForce(model, data, perturb)
    moved = bool(model.body_mocapid[model.body_rootid[perturb.select]] >= 0)
    return Perturb(
        forces=data.xfrc_applied.copy(),
        qpos=data.qpos.copy() if paused else None,
        mocap_pos=data.mocap_pos.copy() if moved else None,
        mocap_quat=data.mocap_quat.copy() if moved else None,
    )


def _rounded(push: Perturb) -> list[Any]:
    return [None if part is None else (part.round(9) + 0.0).tolist() for part in vars(push).values()]
