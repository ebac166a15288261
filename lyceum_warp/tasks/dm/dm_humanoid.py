"""HumanoidStand: a humanoid stands up, and stands still."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    subtree_linvel: Row[wp.vec3]
    sensordata: Row[float]


@wp.struct
class Params(suite.RandomJoints):
    stand_height: float = 1.4  # of the head, m
    move_speed: float = 0.0  # m/s
    torso: int = lw.body("torso")
    head: int = lw.body("head")
    limbs: wp.array[int] = lw.bodies("left_hand", "left_foot", "right_hand", "right_foot")
    contacts: int = lw.sensor("contacts")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    torso = s.xmat[p.torso]
    k = lw.put(obs, 0, s.qpos, 7, s.qpos.shape[0])
    k = lw.put(obs, k, s.xpos[p.head][2])
    for i in range(p.limbs.shape[0]):
        k = lw.put(obs, k, (s.xpos[p.limbs[i]] - s.xpos[p.torso]) * torso)
    k = lw.put(obs, k, torso[2])
    k = lw.put(obs, k, s.subtree_linvel[p.torso])
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    standing = lw.tolerance(s1.xpos[p.head][2], wp.vec2(p.stand_height, wp.inf), p.stand_height / 4.0)
    upright = lw.tolerance(s1.xmat[p.torso][2, 2], wp.vec2(0.9, wp.inf), 1.9, lw.Sigmoid.LINEAR, 0.0)
    stand = standing * upright * suite.small_control(action)
    velocity = s1.subtree_linvel[p.torso]
    if p.move_speed == 0.0:
        still = lw.tolerance(velocity[0], wp.vec2(0.0), 2.0) + lw.tolerance(velocity[1], wp.vec2(0.0), 2.0)
        return stand * still / 2.0
    speed, fast = wp.length(wp.vec2(velocity[0], velocity[1])), wp.vec2(p.move_speed, wp.inf)
    move = lw.tolerance(speed, fast, p.move_speed, lw.Sigmoid.LINEAR, 0.0)
    return stand * (5.0 * move + 1.0) / 6.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)
    # dm_control keeps this non-uniform distribution of rotations for comparable benchmarks
    quat = wp.vec4()
    for i in range(4):
        quat[i] = lw.uniform(rng, 0.0, 1.0)
    lw.put(s.qpos, 3, wp.normalize(quat))


@wp.func
def reject(s: World, p: Params) -> bool:
    return s.sensordata[p.contacts] > 0.0


@lw.register
class HumanoidStand(lw.Task):
    model, frame_skip = suite.model("humanoid"), 5
    obs = {"joint_angles": 21, "head_height": 1, "extremities": 12, "torso_vertical": 3, "com_velocity": 3,
           "velocity": 27}  # fmt: skip

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Add a sensor for contacts (see ``reject``), and remove force sensors that no function reads."""
        for sensor in list(spec.sensors)[1:]:
            spec.delete(sensor)
        suite.count_contacts(spec)


@lw.register
class HumanoidWalk(HumanoidStand):
    """A humanoid walks at 1 m/s."""

    params = {"move_speed": 1.0}


@lw.register
class HumanoidRun(HumanoidStand):
    """A humanoid runs at up to 10 m/s."""

    params = {"move_speed": 10.0}
