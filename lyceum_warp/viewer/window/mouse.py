"""Push the body that the mouse drags, or move it while paused."""

import threading
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.viewer.commands import Command, command, perturb

PULL = ("select", "active", "localpos", "localmass", "refselpos", "refquat")
"""Attributes of a ``mujoco.MjvPerturb`` that determine the force of the mouse."""


class Mouse:
    """Converts drags of the selected body to commands."""

    def __init__(self, send: Callable[[Command], None]) -> None:
        self._send = send
        self._push: dict[str, Any] = {}
        self._tab_lost = False
        self._lock = threading.Lock()

    def drag(self, viewer: Any, *, paused: bool) -> None:
        """Push the selected body while the mouse drags it. If the session is paused, move it instead."""
        with self._lock:
            if self._tab_lost:
                self._tab_lost = False
                viewer.perturb.active = 0
            if not viewer.perturb.active or viewer.perturb.select <= 0:
                return self._end()
            places = _places(viewer.model, viewer.data, viewer.perturb, paused)
            pull = {} if paused else {name: np.copy(getattr(viewer.perturb, name)) for name in PULL}
            push = {name: (values.round(9) + 0.0).tolist() for name, values in (pull | places).items()}
            if push != self._push:
                self._push = push
                self._send(command(perturb, pull, **places))

    def let_go(self) -> None:
        """End a push after the page was closed or hidden. Any thread may call this method."""
        with self._lock:
            self._tab_lost = True  # without a browser, studio does not notice the release of the button
            self._end()

    def _end(self) -> None:
        if self._push:
            self._send(command(perturb, {}))
            self._push = {}


def _places(model: mujoco.MjModel, data: mujoco.MjData, drag: mujoco.MjvPerturb, paused: bool) -> dict[str, np.ndarray]:
    """Return where the mouse puts mocap bodies and, while paused, the robot."""
    mujoco.mjv_applyPerturbPose(model, data, drag, int(paused))
    places = {"qpos": data.qpos.copy()} if paused else {}
    if model.body_mocapid[model.body_rootid[drag.select]] >= 0:
        places |= {"mocap_pos": data.mocap_pos.copy(), "mocap_quat": data.mocap_quat.copy()}
    return places
