"""HiddenPendulum: the inverted double pendulum without velocities and without the constraint force."""

import warp as wp

from lyceum_warp import Row
from lyceum_warp.tasks import inverted_double_pendulum
from lyceum_warp.tasks.inverted_double_pendulum import Params, World


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    for i in range(2):
        obs[1 + i] = wp.sin(s.qpos[1 + i])
        obs[3 + i] = wp.cos(s.qpos[1 + i])


class HiddenPendulum(inverted_double_pendulum.InvertedDoublePendulum):
    obs = {"position": 1, "sines": 2, "cosines": 2}
