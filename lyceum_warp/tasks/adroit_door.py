"""AdroitDoor: turn a latch with the hand and pull the door open (Gymnasium-Robotics' AdroitHandDoor-v1).

Install the extra "hand" to get the hand's model. The door's frame is a mocap body, because its position is part of the
state. The original model contains one contact pair twice: the tips of ring finger and little finger. This model
contains it once. As in Gymnasium-Robotics, site positions are one substep old after ``mj_step``. Because of a mistake
in gymnasium-robotics 1.2.1 to 1.4.2, the reward grows with the palm's distance from the handle. ``palm_weight=-0.1``
restores the reward of version 1.2.0.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # 4 joints of the arm, 24 of the hand, the door's hinge, the latch
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    sparse: bool = False  # the reward is 10 for success, otherwise -0.1
    palm_weight: float = 0.1
    success_angle: float = 1.35  # rad; the hinge opens to 1.57
    frame_low: wp.vec3 = wp.vec3(-0.3, 0.25, 0.252)
    frame_high: wp.vec3 = wp.vec3(-0.2, 0.35, 0.35)
    hinge: int = lw.qpos("door_hinge")
    latch: int = lw.qpos("latch")
    palm: int = lw.site("S_grasp")
    handle: int = lw.site("S_handle")
    frame: int = lw.mocap("frame")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    palm, handle = s.site_xpos[p.palm], s.site_xpos[p.handle]
    k = lw.put(obs, 0, s.qpos, 1, 28)
    k = lw.put(obs, k, s.qpos[p.latch])
    k = lw.put(obs, k, s.qpos[p.hinge])
    k = lw.put(obs, k, palm)
    k = lw.put(obs, k, handle)
    k = lw.put(obs, k, palm - handle)
    lw.put(obs, k, wp.where(s.qpos[p.hinge] > 1.0, 1.0, -1.0))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[p.hinge]


@wp.func
def success(s: World, p: Params) -> bool:
    return s.qpos[p.hinge] >= p.success_angle


@wp.func
def terms(s: World, p: Params) -> wp.vec4:
    angle = s.qpos[p.hinge]
    to_handle = wp.length(s.site_xpos[p.palm] - s.site_xpos[p.handle])
    bonus = wp.where(angle > 0.2, 2.0, 0.0) + wp.where(angle > 1.0, 8.0, 0.0) + wp.where(angle > 1.35, 10.0, 0.0)
    return wp.vec4(
        p.palm_weight * to_handle, -0.1 * (angle - 1.57) * (angle - 1.57), -1e-5 * lw.sum_squares(s.qvel), bonus
    )


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.sparse:
        return wp.where(success(s1, p), 10.0, -0.1)
    t = terms(s1, p)
    return t[0] + t[1] + t[2] + t[3]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.mocap_pos[p.frame] = lw.uniform(rng, p.frame_low, p.frame_high)


@lw.register
class AdroitDoor(lw.Task):
    model = lw.gymnasium_robotics_model("adroit_hand/adroit_door.xml")
    gymnasium = "AdroitHandDoor-v1"
    frame_skip = 5
    obs = {"joints": 27, "latch": 1, "hinge": 1, "palm": 3, "handle": 3, "palm_error": 3, "open": 1}
    metrics = ("palm_to_handle", "opening", "speed", "bonus")
    horizon = 200
    lagged = ("site_xpos",)
    action_range = (-1.0, 1.0)
    planning = lw.Planning(
        settings={"horizon": 32, "samples": 160, "temperature": 0.1, "noise": 1.0}, params={"palm_weight": -1.0}
    )

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.body("frame").mocap = True
