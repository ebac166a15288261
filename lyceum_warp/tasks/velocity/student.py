"""Hide from a robot's policy what the robot cannot measure: its linear velocity. A teacher sees it.

The observation group "teacher" has the observations of the task without the mixin, but no noise.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.velocity import go1, walking


@wp.struct
class Student:
    angular_velocity: Row[wp.vec3] = lw.part()
    gravity: Row[wp.vec3] = lw.part()
    joint_position: Row[float] = lw.part("joints")
    joint_velocity: Row[float] = lw.part("joints")
    last_action: Row[float] = lw.part("joints")
    command: Row[wp.vec3] = lw.part()


@wp.func
def observe(s: walking.World, p: walking.Params, obs: Student, rng: Row[wp.uint32]):
    obs.angular_velocity[0] = terms.angular_velocity(s.qvel)
    obs.gravity[0] = terms.gravity(s.qpos)
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose, s.encoder_bias)
    terms.gather(obs.joint_velocity, s.qvel, p.joint_dof)
    lw.put(obs.last_action, 0, s.last_action)
    obs.command[0] = walking.command(s, p)
    terms.add_uniform_noise(obs.angular_velocity, p.angular_velocity_noise, rng)
    terms.add_uniform_noise(obs.gravity, p.gravity_noise, rng)
    terms.add_uniform_noise(obs.joint_position, p.joint_position_noise, rng)
    terms.add_uniform_noise(obs.joint_velocity, p.joint_velocity_noise, rng)


@wp.func
def observe_teacher(s: walking.World, p: walking.Params, obs: walking.Policy):
    walking.observe_robot(s, p, obs)
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose, s.encoder_bias)


@lw.register
class Go1StudentVelocity(go1.Go1Velocity):
    """A Go1 that walks by its encoders and its inertial sensor; a policy of go1_velocity is its teacher."""

    training = lw.Training(algorithm="distill", settings={"recurrent": 256}, iterations=150, physics="coarse")
