"""SwimmerSwimmer6: a chain of six links swims to a target."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xmat: Row[wp.mat33]
    geom_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    sensordata: Row[float]  # 12 other numbers, then each link's velocimeter and gyroscope


@wp.struct
class Params(suite.RandomJoints):
    head: int = lw.body("head")
    nose: int = lw.geom("nose")
    head_velocity: int = lw.sensor("head_vel")
    target: int = lw.mocap("target")
    target_size: float = lw.from_model(lambda model, p: model.geom("target").size[0])  # radius, m


@wp.func
def nose_to_target(s: World, p: Params) -> wp.vec2:
    v = (s.mocap_pos[p.target] - s.geom_xpos[p.nose]) * s.xmat[p.head]
    return wp.vec2(v[0], v[1])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 3, s.qpos.shape[0])
    k = lw.put(obs, k, nose_to_target(s, p))
    for at in range(p.head_velocity, s.sensordata.shape[0], 6):
        k = lw.put(obs, k, wp.vec3(s.sensordata[at], s.sensordata[at + 1], s.sensordata[at + 5]))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    distance, near = wp.length(nose_to_target(s1, p)), wp.vec2(0.0, p.target_size)
    return lw.tolerance(distance, near, 5.0 * p.target_size, lw.Sigmoid.LONG_TAIL)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)
    box = wp.where(lw.uniform(rng, 0.0, 1.0) < 0.2, 0.3, 2.0)
    for i in range(2):
        s.mocap_pos[p.target][i] = lw.uniform(rng, -box, box)


@lw.register
class SwimmerSwimmer6(lw.Task):
    model, frame_skip = suite.model("swimmer"), 15
    obs = {"joints": 5, "to_target": 2, "body_velocities": 18}
    links = 6

    @classmethod
    def edit_model(cls, spec: mujoco.MjSpec) -> None:
        """Give each world its own target, and add the links behind the head."""
        suite.free_target(spec)
        link, sensor = spec.body("head"), mujoco.mjtSensor
        visual, inertial = spec.find_default("visual"), spec.find_default("inertial")
        for i in range(cls.links - 1):
            link = link.add_body(name=f"segment_{i}", pos=[0.0, 0.1, 0.0])
            link.add_geom(visual, name=f"visual_{i}")
            link.add_geom(inertial, name=f"inertial_{i}")
            link.add_site(spec.find_default("swimmer"), name=f"site_{i}")
            reach = 360.0 / cls.links
            link.add_joint(spec.find_default("swimmer"), name=f"joint_{i}", range=[-reach, reach])
            spec.add_actuator(name=f"motor_{i}", target=f"joint_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
            for kind, name in ((sensor.mjSENS_VELOCIMETER, "velocimeter"), (sensor.mjSENS_GYRO, "gyro")):
                spec.add_sensor(name=f"{name}_{i}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"site_{i}")


@lw.register
class SwimmerSwimmer15(SwimmerSwimmer6):
    """A chain of fifteen links swims to a target."""

    obs = {"joints": 14, "to_target": 2, "body_velocities": 45}
    links = 15
