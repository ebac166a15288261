"""Define an inverted pendulum whose policy sees positions only. A teacher sees velocities, too."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks import inverted_pendulum
from lyceum_warp.tasks.inverted_pendulum import Params, World


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    lw.put(obs, 0, s.qpos)


@wp.func
def observe_teacher(s: World, p: Params, obs: Row[float]):
    inverted_pendulum.observe(s, p, obs)


class Hidden(inverted_pendulum.InvertedPendulum):
    obs = {"policy": {"position": 2}, "teacher": {"position": 2, "velocity": 2}}
