"""Define a cheetah that runs at a commanded speed, with most features that a task can have."""

from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task

GAIT = 0.4 * np.sin(np.pi * np.arange(20)[:, None] / 10 + np.array([0.0, 0.8, 1.6, 3.1, 3.9, 4.7]))  # rad


def cheetah() -> mujoco.MjSpec:
    """Add two touch sensors and a crouched keyframe to Gymnasium's cheetah."""
    spec = lw.gymnasium_model("half_cheetah.xml").spec()
    for foot in ("bfoot", "ffoot"):
        spec.body(foot).add_site(name=foot, pos=[0.0, 0.0, -0.1], size=[0.15, 0.15, 0.15])
        spec.add_sensor(name=foot, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=foot)
    spec.add_key(name="crouch", qpos=[0.0, -0.05, 0.0, 0.2, -0.2, 0.1, -0.2, 0.2, -0.1])
    return spec


@wp.struct
class World:
    time: float
    qpos: Row[float]
    qvel: Row[float]
    sensordata: Row[float]
    gravity: Row[float]  # four model fields, which startup and randomize write in each world
    body_mass: Row[float]
    geom_friction: Row[wp.vec3]
    actuator_gainprm: Row[lw.vec10]
    command: Row[float] = lw.memory()  # m/s
    air_time: Row[float] = lw.memory()  # seconds since a foot touched the ground
    level: Row[float] = lw.lasting_memory()  # level of the curriculum, 0 to 1


@wp.struct
class Params:
    dt: float
    substep_dt: float
    noise: float = 0.02
    fastest: float = 4.0  # command at level 1, m/s
    push: float = 0.5  # standard deviation, m/s
    gait: wp.array2d[float] = GAIT  # joint angles to imitate, one row per phase
    period: float = 0.4  # of the gait, s
    feet: wp.array[int] = lw.sensors("bfoot", "ffoot")
    floor: int = lw.geom("floor")


@wp.struct
class Policy:  # noisy measurements of the robot
    position: Row[float] = lw.part(8)
    velocity: Row[float] = lw.part(9)
    command: Row[float] = lw.part()
    phase: Row[wp.vec2] = lw.part()


@wp.struct
class Critic(Policy):  # privileged observations, available in simulation only
    mass: Row[float] = lw.part(7)
    friction: Row[float] = lw.part()
    gravity: Row[float] = lw.part()


@wp.func
def observe_robot(s: World, p: Params, obs: Any):  # for both groups
    for i in range(8):
        obs.position[i] = s.qpos[i + 1]
    for i in range(9):
        obs.velocity[i] = s.qvel[i]
    obs.command[0] = s.command[0]
    angle = wp.tau * s.time / p.period
    obs.phase[0] = wp.vec2(wp.sin(angle), wp.cos(angle))


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    observe_robot(s, p, obs)
    for i in range(8):
        obs.position[i] += p.noise * lw.normal(rng)
    for i in range(9):
        obs.velocity[i] += 10.0 * p.noise * lw.normal(rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_robot(s, p, obs)
    for i in range(7):
        obs.mass[i] = s.body_mass[i + 1]
    obs.friction[0] = s.geom_friction[p.floor][0]
    obs.gravity[0] = s.gravity[2]


@wp.func
def tracking(s0: World, s1: World, p: Params) -> float:
    error = (s1.qpos[0] - s0.qpos[0]) / p.dt - s0.command[0]
    return wp.exp(-error * error)


@wp.func
def imitation(s: World, p: Params) -> float:
    row = int(s.time / p.period * float(p.gait.shape[0])) % p.gait.shape[0]
    distance = float(0.0)
    for i in range(6):
        distance += (s.qpos[3 + i] - p.gait[row, i]) ** 2.0
    return wp.exp(-2.0 * distance)


@wp.func
def effort(action: Row[float]) -> float:
    return lw.sum_squares(action)


@wp.func
def flight(air_time: Row[float]) -> float:
    return wp.min(air_time[0], 0.5)


@wp.func
def difficulty(level: Row[float]) -> float:
    return level[0]


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):  # runs once for each world, when the environment is made
    s.gravity[2] = s.gravity[2] * lw.uniform(rng, 0.95, 1.05)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):  # runs at every reset, from nominal values
    for i in range(1, 8):
        s.body_mass[i] = s.body_mass[i] * lw.uniform(rng, 0.8, 1.2)
    for i in range(6):
        s.actuator_gainprm[i][0] = lw.uniform(rng, 0.9, 1.1)
    s.geom_friction[p.floor][0] = lw.uniform(rng, 0.3, 1.0)
    s.command[0] = lw.uniform(rng, 0.0, 1.0 + s.level[0] * (p.fastest - 1.0))


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):  # mean times: 2 s between commands, 1 s between pushes
    if lw.uniform(rng, 0.0, 2.0) < p.dt:
        s.command[0] = lw.uniform(rng, 0.0, 1.0 + s.level[0] * (p.fastest - 1.0))
    if lw.uniform(rng, 0.0, 1.0) < p.dt:
        s.qvel[0] += p.push * lw.normal(rng)


@wp.func
def substep(s: World, p: Params):
    touching = s.sensordata[p.feet[0]] + s.sensordata[p.feet[1]] > 0.0
    s.air_time[0] = wp.where(touching, 0.0, s.air_time[0] + p.substep_dt)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    well = tracking(s0, s1, p) > 0.7  # a higher level gives faster commands
    s1.level[0] = wp.clamp(s0.level[0] + wp.where(well, 1e-3, -1e-3), 0.0, 1.0)


@lw.register
class CommandedSpeed(lw.Task):
    model, frame_skip, horizon, keyframe, settle = staticmethod(cheetah), 5, 400, "crouch", 20
    rewards = {"tracking": 1.0, "imitation": 0.3, "effort": -0.02, "flight": -0.5}  # weights per second
    metrics = ("difficulty",)


if __name__ == "__main__":
    for engine in ("mujoco", "warp"):
        print(check_task(CommandedSpeed, engine=engine, steps=50))
    env = lw.make(CommandedSpeed)
    env.step()
    print("reward", env.reward.item(), "of", {name: metric.item() for name, metric in env.metrics.items()})
