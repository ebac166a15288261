"""FingerSpin: a finger with two joints spins a body."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]  # proximal, distal, hinge
    qvel: Row[float]
    xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    sensordata: Row[float]


@wp.struct
class Params(suite.RandomJoints):
    spin_velocity: float = 15.0  # rad/s
    spin_margin: float = 0.0  # rad/s
    spinner: int = lw.body("spinner")
    tip: int = lw.site("tip")
    touch_top: int = lw.sensor("touchtop")
    touch_bottom: int = lw.sensor("touchbottom")
    contacts: int = lw.sensor("contacts")


@wp.func
def relative(s: World, p: Params, point: wp.vec3) -> wp.vec2:  # x and z of a point, relative to the hinge
    v = point - s.xpos[p.spinner]
    return wp.vec2(v[0], v[2])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 2)
    k = lw.put(obs, k, relative(s, p, s.site_xpos[p.tip]))
    k = lw.put(obs, k, s.qvel)
    lw.put(obs, k, wp.vec2(suite.log1p(s.sensordata[p.touch_top]), suite.log1p(s.sensordata[p.touch_bottom])))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return lw.tolerance(s1.qvel[2], wp.vec2(-wp.inf, -p.spin_velocity), p.spin_margin, lw.Sigmoid.LINEAR, 0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)


@wp.func
def reject(s: World, p: Params) -> bool:
    return s.sensordata[p.contacts] > 0.0


@lw.register
class FingerSpin(lw.Task):
    model, frame_skip = suite.model("finger"), 2
    obs = {"position": 4, "velocity": 3, "touch": 2}
    # planners hold each torque for two steps, and get the full reward only at 20 rad/s instead of 15 rad/s
    planning = lw.Planning(
        settings={
            "horizon": 16, "samples": 32, "knots": 8, "spline": "zero", "noise": 2.0, "temperature": 0.02,
        },
        params={"spin_velocity": 20.0, "spin_margin": 35.0},
    )  # fmt: skip

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Count contacts for ``reject``, let the body spin easily, and hide the target."""
        suite.count_contacts(spec)
        spec.joint("hinge").damping[0] = 0.03
        for site in ("target", "tip"):
            spec.site(site).rgba[3] = 0.0


# turn


@wp.struct
class TurnWorld(World):
    mocap_pos: Row[wp.vec3]


@wp.struct
class TurnParams(Params):
    target: int = lw.mocap("target")
    target_size: float = lw.from_model(lambda model, p: model.site("target").size[0])  # radius, m
    hinge: wp.vec3 = lw.from_model(lambda model, p: model.body_pos[p.spinner])  # position of the spinner's hinge, m
    radius: float = lw.from_model(lambda model, p: model.geom("cap1").size.sum())  # of the spinner, m


@wp.func
def distance_to_target(s: TurnWorld, p: TurnParams) -> float:  # negative inside the target
    v = s.mocap_pos[p.target] - s.site_xpos[p.tip]
    return wp.length(wp.vec2(v[0], v[2])) - p.target_size


@wp.func
def observe_turn(s: TurnWorld, p: TurnParams, obs: Row[float]):
    observe(s, p, obs)  # the first 9 numbers
    k = lw.put(obs, 9, relative(s, p, s.mocap_pos[p.target]))
    lw.put(obs, k, distance_to_target(s, p))


@wp.func
def reward_turn(s0: TurnWorld, action: Row[float], s1: TurnWorld, p: TurnParams) -> float:
    return wp.where(distance_to_target(s1, p) <= 0.0, 1.0, 0.0)


@wp.func
def randomize_turn(s: TurnWorld, p: TurnParams, rng: Row[wp.uint32]):
    randomize(s, p, rng)
    angle = lw.uniform(rng, -wp.pi, wp.pi)
    s.mocap_pos[p.target][0] = p.hinge[0] + p.radius * wp.sin(angle)
    s.mocap_pos[p.target][2] = p.hinge[2] + p.radius * wp.cos(angle)


@lw.register
class FingerTurnEasy(lw.Task):
    """A finger with two joints turns a body until the body's tip is in a large target."""

    model, frame_skip = suite.model("finger"), 2
    World, Params = TurnWorld, TurnParams
    observe, reward, randomize = observe_turn, reward_turn, randomize_turn
    obs = FingerSpin.obs | {"target_position": 2, "dist_to_target": 1}
    target_radius = 0.07  # m

    @classmethod
    def edit_model(cls, spec: mujoco.MjSpec) -> None:
        suite.count_contacts(spec)
        suite.free_target(spec)
        spec.site("target").size[0] = cls.target_radius


@lw.register
class FingerTurnHard(FingerTurnEasy):
    """A finger with two joints turns a body until the body's tip is in a small target."""

    World, Params = TurnWorld, TurnParams
    observe, reward, randomize = observe_turn, reward_turn, randomize_turn
    target_radius = 0.03
