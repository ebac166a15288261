"""Define in-hand rotation: spin an object about the vertical axis, as in MuJoCo Playground's LeapCubeRotateZAxis.

The palm faces upwards and does not move. The model has a site ``grasp_site`` above the palm, a geom and a site of the
same name at each fingertip, one free joint, which is the object's, a keyframe "home", and a position servo for each of
the hand's joints. An action is an offset of the servos' targets from the pose of the keyframe.

Differences from Playground: the last action in an observation is the latest one, the critic's observation has no noise,
positions are those after the last substep, and worlds differ in friction, damping, gains and the object's mass.
"""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms, walkers
from lyceum_warp.tasks.hands import gates


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    geom_friction: Row[wp.vec3]
    body_mass: Row[float]
    body_inertia: Row[wp.vec3]
    dof_damping: Row[float]
    dof_frictionloss: Row[float]
    jnt_range: Row[wp.vec2]
    actuator_gainprm: Row[lw.vec10]
    actuator_biasprm: Row[lw.vec10]
    last_action: Row[float] = lw.memory("joints")


def free_joint(model: mujoco.MjModel) -> int:
    """Get the object's joint.

    Raises:
        ValueError: The model does not have exactly one free joint.
    """
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(joints) != 1:
        raise ValueError(f"the model has {len(joints)} free joints, but the object in the hand needs exactly one")
    return int(joints[0])


@wp.struct
class Params:
    dt: float  # seconds in a step
    # the hand and the object
    joints: wp.array[int] = lw.joints()  # the hand's joints, in the order of actions and observations
    joint_qpos: wp.array[int] = lw.from_model(walkers.joint_qpos)  # indices of the joints in qpos
    joint_dof: wp.array[int] = lw.from_model(walkers.joint_dof)  # indices of the joints in qvel
    servos: wp.array[int] = lw.from_model(walkers.servos)  # of the joints
    default_pose: wp.array[float] = lw.from_model(walkers.home_pose)  # of the joints, rad
    palm: int = lw.site("grasp_site")
    tips: wp.array[int] = lw.sites()  # a site at each fingertip
    tip_geoms: wp.array[int] = lw.from_model(lambda model, p: [model.geom(model.site(i).name).id for i in p.tips])
    object: wp.array[int] = lw.from_model(lambda model, p: [model.jnt_bodyid[free_joint(model)]])  # its body
    object_qpos: int = lw.from_model(lambda model, p: int(model.jnt_qposadr[free_joint(model)]))
    object_dof: int = lw.from_model(lambda model, p: int(model.jnt_dofadr[free_joint(model)]))
    action_scale: float = 0.6  # rad for an action of 1
    drop_height: float = -0.05  # of the object; an episode ends below it, m
    reach: float = 0.5  # distance of the object from the palm's site; an episode ends beyond it, m
    # starts
    start_position: wp.vec3 = wp.vec3(0.1, 0.0, 0.05)  # of the object, m
    start_offset: wp.vec3 = wp.vec3(0.01, 0.01, 0.01)  # largest offset of the object, m
    start_pose_std: float = 0.1  # of the joints, rad
    # noise on the policy's observations
    joint_position_noise: float = 0.05  # bound of the uniform noise, rad
    # differences between worlds
    tip_friction: wp.vec2 = wp.vec2(0.5, 1.0)  # range of the fingertips' sliding friction
    object_mass: wp.vec2 = wp.vec2(0.8, 1.2)  # range of the factor of the object's mass
    joint_damping: wp.vec2 = wp.vec2(0.8, 1.2)  # range of the factors
    joint_friction: wp.vec2 = wp.vec2(0.5, 2.0)  # range of the factors of the joints' dry friction
    kp: wp.vec2 = wp.vec2(0.8, 1.2)  # range of the factors of the servos' gains


@wp.struct
class Policy:
    joint_position: Row[float] = lw.part("joints")
    last_action: Row[float] = lw.part("joints")


@wp.struct
class Critic(Policy):
    joint_velocity: Row[float] = lw.part("joints")
    fingertip: Row[wp.vec3] = lw.part("tips")  # from the palm's site
    object_position: Row[wp.vec3] = lw.part()  # from the palm's site
    object_axes: Row[wp.vec3] = lw.part(2)
    object_velocity: Row[wp.vec3] = lw.part()
    object_angular_velocity: Row[wp.vec3] = lw.part()


# the object


@wp.func
def position(s: World, p: Params) -> wp.vec3:
    k = p.object_qpos
    return wp.vec3(s.qpos[k], s.qpos[k + 1], s.qpos[k + 2])


@wp.func
def rotation(s: World, p: Params) -> lw.quat:
    k = p.object_qpos + 3
    return lw.quat(s.qpos[k], s.qpos[k + 1], s.qpos[k + 2], s.qpos[k + 3])


@wp.func
def object_velocity(s: World, p: Params) -> wp.vec3:
    k = p.object_dof
    return wp.vec3(s.qvel[k], s.qvel[k + 1], s.qvel[k + 2])


@wp.func
def object_angular_velocity(s: World, p: Params) -> wp.vec3:  # in the world's axes
    k = p.object_dof + 3
    return lw.quat_rotate(rotation(s, p), wp.vec3(s.qvel[k], s.qvel[k + 1], s.qvel[k + 2]))


@wp.func
def put_axes(axes: Row[wp.vec3], turn: lw.quat):
    """Write the last two rows of a rotation matrix, which describe a rotation without a jump."""
    m = lw.quat_to_mat(turn)
    axes[0] = m[1]
    axes[1] = m[2]


# actions and observations


@wp.func
def clipped(action: Row[float], j: int) -> float:
    return wp.clamp(action[j], -1.0, 1.0)


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.joints.shape[0]):
        ctrl[p.servos[j]] = p.default_pose[j] + p.action_scale * clipped(action, j)


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    terms.gather(obs.joint_position, s.qpos, p.joint_qpos)
    terms.add_uniform_noise(obs.joint_position, p.joint_position_noise, rng)
    lw.put(obs.last_action, 0, s.last_action)


@wp.func
def observe_exactly(s: World, p: Params, obs: Any):
    """Write what the critics of all tasks know."""
    terms.gather(obs.joint_position, s.qpos, p.joint_qpos)
    terms.gather(obs.joint_velocity, s.qvel, p.joint_dof)
    lw.put(obs.last_action, 0, s.last_action)
    for i in range(p.tips.shape[0]):
        obs.fingertip[i] = s.site_xpos[p.tips[i]] - s.site_xpos[p.palm]
    obs.object_position[0] = position(s, p) - s.site_xpos[p.palm]
    obs.object_velocity[0] = object_velocity(s, p)
    obs.object_angular_velocity[0] = object_angular_velocity(s, p)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_exactly(s, p, obs)
    put_axes(obs.object_axes, rotation(s, p))


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    for j in range(p.joints.shape[0]):
        s1.last_action[j] = clipped(action, j)


# worlds and starts


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    friction = lw.uniform(rng, p.tip_friction[0], p.tip_friction[1])
    for i in range(p.tip_geoms.shape[0]):
        old = s.geom_friction[p.tip_geoms[i]]
        s.geom_friction[p.tip_geoms[i]] = wp.vec3(friction, old[1], old[2])
    terms.scale_mass(s.body_mass, s.body_inertia, p.object, p.object_mass, rng)
    terms.scale_elements(s.dof_damping, p.joint_dof, p.joint_damping, rng)
    terms.scale_elements(s.dof_frictionloss, p.joint_dof, p.joint_friction, rng)
    terms.scale_gains(s.actuator_gainprm, s.actuator_biasprm, p.servos, p.kp, wp.vec2(1.0, 1.0), rng)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for j in range(p.joints.shape[0]):
        limits = s.jnt_range[p.joints[j]]
        angle = p.default_pose[j] + p.start_pose_std * lw.normal(rng)
        s.qpos[p.joint_qpos[j]] = wp.clamp(angle, limits[0], limits[1])
    k = lw.put(s.qpos, p.object_qpos, p.start_position + lw.uniform(rng, -p.start_offset, p.start_offset))
    lw.put(s.qpos, k, lw.quat_random(rng))


# terms


@wp.func
def dropped(s: World, p: Params) -> bool:
    away = wp.length(position(s, p) - s.site_xpos[p.palm]) > p.reach  # contacts can throw an object upwards
    return away or position(s, p)[2] < p.drop_height


@wp.func
def spin(s: World, p: Params) -> float:  # rad/s
    return object_angular_velocity(s, p)[2]


@wp.func
def drop(dropped: bool) -> float:
    return wp.where(dropped, 1.0, 0.0)


@wp.func
def excess_l2(action: Row[float]) -> float:
    """Return the sum of max(|a| - 1, 0)^2. Without this cost, nothing would keep a policy near the range of actions."""
    total = float(0.0)
    for j in range(action.shape[0]):
        excess = wp.max(wp.abs(action[j]) - 1.0, 0.0)
        total += excess * excess
    return total


@wp.func
def evaluate(s: World, p: Params) -> float:
    return spin(s, p)


class Rotate(lw.Task):
    """A hand spins an object about the vertical axis as fast as it can, and does not drop it."""

    frame_skip, horizon, keyframe = 5, 500, "home"
    gate = gates.Turns("spin", "rotation, rad,", least=50.0, drops=20.0)
    rewards = {"spin": 1.0, "drop": -100.0, "excess_l2": -0.1}
    terminations = ("dropped",)
    actions = {"joint_position": "joints"}
    planning = lw.Planning(
        settings={"horizon": 16, "samples": 128, "temperature": 0.02, "noise": 0.6}, params={"drop": -400.0}
    )
    training = lw.Training(
        algorithm="ppo",
        iterations=600,
        settings={"gamma": 0.97, "log_std": -0.7, "entropy_coef": 0.001},
    )

    @staticmethod
    def deployment(model: mujoco.MjModel, p: Any, memory: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return walkers.servo_metadata(model, p)
