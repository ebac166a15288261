"""Steer a walking robot by the user's commands, and show commanded and measured velocities as arrows.

The task must store its command like the velocity tasks (see ``docs/velocity.md``). The robot's first joint must be the
free joint of its base.
"""

import math
from collections.abc import Sequence

import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import Arrow, Velocity
from lyceum_warp.viewer.session.live import Live

_MEMORY = ("drawn_velocity", "heading_target", "heading_controlled", "standing", "command_timer")
_NEVER = 1e9  # seconds until the task chooses a new command
# arrows start _HEIGHT metres above the base; the length of an arrow is its velocity times _SECONDS
_HEIGHT, _SECONDS = 0.25, 0.4
_COMMANDED, _MEASURED = (0.1, 0.35, 0.95, 1.0), (0.1, 0.85, 0.55, 1.0)
_SCALE = f"{_SECONDS:g} m per m/s; up: turn left, {_SECONDS:g} m per rad/s"


class Driving:
    """Reads and replaces the command of a walking robot."""

    def __init__(self, env: Env) -> None:
        self._parts, self._params = env.state_space.parts, env.task.params
        self.limits: Velocity | None = None
        """The task's largest forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s)."""
        if all(name in self._parts for name in _MEMORY):
            _, _, forward, turn = np.asarray(self._params["stages"])[0]
            self.limits = float(forward), float(self._params["lateral_velocity"]), float(turn)
        self.velocity: Velocity | None = None
        """The user's command, or None if the task chooses its commands."""

    def command(self, state: np.ndarray) -> Velocity | None:
        """Return the commanded forward velocity, lateral velocity and yaw rate in a state, (state_space.size,)."""
        if self.limits is None:
            return None
        velocity, target, controlled, standing, _ = (state[self._parts[name]] for name in _MEMORY)
        if standing[0] > 0:
            return 0.0, 0.0, 0.0
        turn = velocity[2]
        if controlled[0] > 0:
            most, off = np.asarray(self._params["stages"])[0, 3], target[0] - _yaw(state[self._parts["qpos"]])
            turn = np.clip(self._params["heading_gain"] * math.remainder(off, math.tau), -most, most)
        return float(velocity[0]), float(velocity[1]), float(turn)

    def apply(self, live: Live) -> None:
        """Write the user's command into the displayed world, or let the task choose a command in the next step."""
        if self.velocity is None:
            live.write(command_timer=np.zeros(1))
        else:
            none = dict.fromkeys(("heading_controlled", "standing"), np.zeros(1))
            live.write(drawn_velocity=np.array(self.velocity), command_timer=np.array([_NEVER]), **none)

    def arrows(self, state: np.ndarray) -> tuple[Arrow, ...]:
        """Make arrows above the base: horizontal ones for velocities, and vertical ones for yaw rates."""
        if (command := self.command(state)) is None:
            return ()
        qpos, qvel = state[self._parts["qpos"]], state[self._parts["qvel"]]
        yaw, start = _yaw(qpos), qpos[:3] + np.array([0.0, 0.0, _HEIGHT])
        forward = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        left, up = np.array([-forward[1], forward[0], 0.0]), np.array([0.0, 0.0, 1.0])
        ways: Sequence[tuple[np.ndarray, tuple[float, float, float, float]]] = (
            (command[0] * forward + command[1] * left, _COMMANDED), (qvel[:3] * [1.0, 1.0, 0.0], _MEASURED),
            (command[2] * up, _COMMANDED), (qvel[5] * up, _MEASURED),
        )  # fmt: skip
        names = {_COMMANDED: f"commanded velocity, {_SCALE}", _MEASURED: "measured velocity"}
        return tuple(Arrow(start, start + _SECONDS * way, colour, names[colour]) for way, colour in ways)


def _yaw(qpos: np.ndarray) -> float:
    w, x, y, z = qpos[3:7]
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
