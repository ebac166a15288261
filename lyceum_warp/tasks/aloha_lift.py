"""AlohaLift: two arms take a pot by its handles and lift it (ALOHA with the pot of mujoco_warp's test data).

The model comes with mujoco_warp, where it is test data: another release may move it. All its shapes are meshes there;
here the arms collide as capsules around them, the fingers as two capsules each, the pot as two boxes with a capsule for
each handle, and the table as a plane. The arms collide with pot and table, not with each other or with the frame.
Masses stay those of the meshes. Actions are velocities: each moves the target of a position actuator, with the model's
own gains. The reward is a sum of terms between 0 and 1, each a mean over both arms or that of the worse: for reaching
the handles, for turning the fingers across them, for closing, and for lifting the pot upright. An episode is a success
while the pot was held up for ten steps.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

POT = "partnet_100015/"
ARM = (0.0, -1.05, 1.06, 0.0, 0.78, 1.57, 0.035, 0.035)
"""Joints of an arm and its fingers at the start: beside a handle and above it, one finger above the other."""


@wp.struct
class World:
    qpos: Row[float]  # 8 of the left arm, 8 of the right one, the pot's position and quaternion, its lid
    qvel: Row[float]
    act: Row[float]  # targets of the arms' joints and grippers
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    site_xpos: Row[wp.vec3]
    site_xmat: Row[wp.mat33]
    memory: Row[float]  # steps in which the pot was held up


@wp.struct
class Params:
    dt: float
    pot: int = lw.body(POT)
    pot_qpos: int = lw.qpos(POT)
    left_grip: int = lw.site("left/grip")
    right_grip: int = lw.site("right/grip")
    left_handle: int = lw.site("left/handle")
    right_handle: int = lw.site("right/handle")
    left_finger: int = lw.qpos("left\\left_finger")
    right_finger: int = lw.qpos("right\\left_finger")
    goal_height: float = 0.1
    goal_steps: float = 10.0
    rest_height: float = 0.066  # of the pot on the table
    place: wp.vec3 = wp.vec3(0.03, 0.03, 0.25)  # of the pot at the start: x, y and yaw, each plus or minus this


@wp.func
def axis(mat: wp.mat33, i: int) -> wp.vec3:
    return wp.vec3(mat[0, i], mat[1, i], mat[2, i])


@wp.func
def height(s: World, p: Params) -> float:
    return s.xpos[p.pot][2] - p.rest_height


@wp.func
def arm_terms(s: World, grip: int, handle: int, finger: int) -> wp.vec4:
    """Reaching, turning and closing of one arm, and how closely it is around its handle."""
    distance = wp.length(s.site_xpos[grip] - s.site_xpos[handle])
    around = lw.tolerance(distance, wp.vec2(0.0, 0.01), 0.01)
    closed = lw.tolerance(s.qpos[finger], wp.vec2(0.0, 0.015), 0.02, int(lw.Sigmoid.LINEAR))
    return wp.vec4(
        lw.tolerance(distance, wp.vec2(0.0, 0.005), 0.1, int(lw.Sigmoid.RECIPROCAL), 0.2),
        # the fingers move along the y axis of the gripper, the handle's bar is the x axis of the pot
        1.0 - wp.abs(wp.dot(axis(s.site_xmat[grip], 1), axis(s.site_xmat[handle], 0))),
        around * closed + 0.5 * (1.0 - around) * (1.0 - closed),
        around,
    )


@wp.func
def terms(s: World, p: Params) -> wp.vec4:
    left = arm_terms(s, p.left_grip, p.left_handle, p.left_finger)
    right = arm_terms(s, p.right_grip, p.right_handle, p.right_finger)
    both = 0.5 * (left + right)
    upright = wp.max(s.xmat[p.pot][2, 2], 0.0)
    up = wp.clamp(height(s, p) / (1.5 * p.goal_height), 0.0, 1.0)
    return wp.vec4(both[0], both[1], both[2], wp.min(left[3], right[3]) * upright * up)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 16)
    k = lw.put(obs, k, s.qvel, 0, 22)
    k = lw.put(obs, k, s.act)
    k = lw.put(obs, k, s.xpos[p.pot])
    k = lw.put(obs, k, s.xmat[p.pot])
    k = lw.put(obs, k, s.site_xpos[p.left_handle] - s.site_xpos[p.left_grip])
    k = lw.put(obs, k, s.site_xpos[p.right_handle] - s.site_xpos[p.right_grip])


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    t = terms(s1, p)
    return t[0] + 0.5 * t[1] + t[2] + 4.0 * t[3] - 0.005 * lw.sum_squares(action)


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return height(s, p)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    held = height(s1, p) > p.goal_height
    s1.memory[0] = wp.where(held, s0.memory[0] + 1.0, 0.0)


@wp.func
def success(s: World, p: Params) -> bool:
    return s.memory[0] >= p.goal_steps


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[p.pot_qpos] += lw.uniform(rng, -p.place[0], p.place[0])
    s.qpos[p.pot_qpos + 1] += lw.uniform(rng, -p.place[1], p.place[1])
    half = 0.5 * (0.5 * wp.pi + lw.uniform(rng, -p.place[2], p.place[2]))
    s.qpos[p.pot_qpos + 3] = wp.cos(half)
    s.qpos[p.pot_qpos + 6] = wp.sin(half)


@lw.register
class AlohaLift(lw.Task):
    model = lw.package_model("mujoco_warp", "test_data/aloha_pot/scene.xml", install="mujoco-warp>=4.0,<5")
    keyframe = "home"
    frame_skip = 8
    obs = {"position": 16, "velocity": 22, "target": 14, "pot": 3, "pot_axes": 9, "handles_from_grips": 6}
    metrics = ("reach", "turn", "grasp", "lift")
    horizon = 150
    memory = 1
    action_range = (-1.0, 1.0)
    planning = lw.Planning(settings={"horizon": 16, "samples": 128, "temperature": 0.5, "noise": 0.6})

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Let simple shapes collide, and turn the servos' inputs into velocities."""
        capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
        spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for actuator in spec.actuators:
            gripper = actuator.name.endswith("gripper")
            actuator.actrange = actuator.ctrlrange
            actuator.set_to_intvelocity(kp=actuator.gainprm[0], kv=-actuator.biasprm[2])
            actuator.ctrlrange = (-0.1, 0.1) if gripper else (-1.0, 1.0)  # m/s, rad/s
        for geom in spec.geoms:
            if geom.classname.name == "collision" and geom.name != "table":
                geom.type, geom.contype = capsule, 0
            else:
                geom.contype = geom.conaffinity = 0
            if geom.name.startswith(POT):
                geom.rgba, geom.group = (0.75, 0.77, 0.8, 1.0), 2
        spec.body("table").add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1), pos=(0, 0, 0.7509), group=3)
        pad = {"type": capsule, "size": (0.005, 0, 0), "condim": 4, "friction": (1, 0.02, 1e-4), "contype": 0,
               "solref": (0.01, 1), "group": 3}  # fmt: skip
        pot = spec.body(POT)
        for turn in (0.0, 0.25 * 3.14159265):
            pot.add_geom(type=box, size=(0.083, 0.083, 0.058), pos=(-0.005, 0, -0.007), mass=0, group=3,
                         axisangle=(0, 0, 1, turn))  # fmt: skip
        for side, y in (("left", 0.1765), ("right", -0.1745)):
            pot.add_site(name=f"{side}/handle", pos=(-0.005, y, 0.0625))
            pot.add_geom(type=capsule, size=(0.0055, 0, 0), fromto=(-0.05, y, 0.0625, 0.042, y, 0.0625), mass=0,
                         condim=4, group=3)  # fmt: skip
            spec.body(f"{side}\\gripper_link").add_site(name=f"{side}/grip", pos=(0.13, 0, 0))
            for finger, sign in (("left", -1.0), ("right", 1.0)):
                for x in (0.0105, 0.0195):
                    spec.body(f"{side}\\{finger}_finger_link").add_geom(
                        fromto=(x, sign * 0.03, 0.022, x, sign * 0.085, 0.022), mass=0, **pad)
        for key in spec.keys:
            spec.delete(key)
        pot_at = (0.0, 0.0, 0.0661, 0.7071068, 0.0, 0.0, 0.7071068, 0.0)
        spec.add_key(name="home", qpos=[*ARM, *ARM, *pot_at], act=[*ARM[:7], *ARM[:7]])
