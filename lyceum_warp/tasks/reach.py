"""Reach: move the hand of a 7-joint arm to a target in space (the arm that the Lyceum paper calls Sawyer).

Gravity does not act on the arm. Its target is a mocap body, and so belongs to the state. An episode is a success
while the distance, averaged over ten steps, is under 5 cm. With ``random_start`` one episode in five begins with the
palm inside the table, whose contact forces push it out.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

vec7 = wp.types.vector(length=7, dtype=wp.float32)

JOINTS = (  # name, axis, range in radians, damping, gear of its motor
    ("shoulder_pan", (0, 0, 1), (-2.2854, 1.714602), 2.0, 20),
    ("shoulder_lift", (0, 1, 0), (-0.5236, 1.3963), 2.0, 10),
    ("upper_arm_roll", (1, 0, 0), (-1.5, 1.7), 0.8, 10),
    ("elbow_flex", (0, 1, 0), (-2.3213, 0.0), 0.8, 10),
    ("forearm_roll", (1, 0, 0), (-1.5, 1.5), 0.8, 10),
    ("wrist_flex", (0, 1, 0), (-1.094, 0.0), 0.8, 10),
    ("wrist_roll", (1, 0, 0), (-1.5, 1.5), 0.8, 10),
)
LOWEST = wp.constant(vec7(*(joint[2][0] for joint in JOINTS)))
HIGHEST = wp.constant(vec7(*(joint[2][1] for joint in JOINTS)))

REMEMBERED = 10
"""Distances that the task remembers, one a step."""
FAR = 10.0
"""Metres in the place of a distance that is not there yet: with one of these, the average is never a success."""


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    memory: Row[float]  # the last distances, the latest at the end


@wp.struct
class Params:
    dt: float
    success_distance: float = 0.05
    random_start: bool = False  # joints anywhere in their ranges, as in the paper's text, not at zero as in its code
    target_range: wp.vec3 = wp.vec3(0.3, 0.2, 0.25)
    finger: int = lw.site("finger")
    target: int = lw.mocap("target")


@wp.func
def error(s: World, p: Params) -> wp.vec3:
    return s.site_xpos[p.finger] - s.mocap_pos[p.target]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    e = error(s, p)
    for i in range(7):
        obs[i] = s.qpos[i]
        obs[7 + i] = s.qvel[i]
    for i in range(3):
        obs[14 + i] = s.site_xpos[p.finger][i]
        obs[17 + i] = e[i]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    e = error(s1, p)
    return -(wp.abs(e[0]) + wp.abs(e[1]) + wp.abs(e[2])) - 5.0 * wp.length(e)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(error(s, p))


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    for i in range(REMEMBERED - 1):
        s1.memory[i] = s0.memory[i + 1]
    s1.memory[REMEMBERED - 1] = wp.length(error(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    total = float(0.0)
    for i in range(REMEMBERED):
        total += s.memory[i]
    return total / float(REMEMBERED) < p.success_distance


@wp.func
def initialize(s: World, p: Params):
    for i in range(REMEMBERED):
        s.memory[i] = FAR


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(3):
        s.mocap_pos[p.target][i] = lw.uniform(rng, -p.target_range[i], p.target_range[i])
    if p.random_start:
        for i in range(7):
            s.qpos[i] = lw.uniform(rng, LOWEST[i], HIGHEST[i])


def arm() -> mujoco.MjSpec:
    """An arm of capsules and spheres beside a table, of which only the palm collides with it."""
    spec = mujoco.MjSpec()
    spec.modelname = "reach"
    spec.compiler.degree = False
    spec.option.timestep = 0.01
    spec.option.gravity = (0, 0, 0)
    shape, kind = mujoco.mjtGeom, mujoco.mjtJoint
    metal, dark, glass = (0.75, 0.77, 0.8, 1), (0.2, 0.22, 0.26, 1), (0.9, 0.3, 0.2, 0.5)
    contact = {"condim": 1, "margin": 0.002, "friction": (0.5, 0.1, 0.1)}

    def ball(body, radius, position, colour, collides=0):
        body.add_geom(type=shape.mjGEOM_SPHERE, size=(radius, 0, 0), pos=position, rgba=colour, contype=collides,
                      conaffinity=collides, **contact)  # fmt: skip

    def rod(body, radius, start, end, colour):
        body.add_geom(type=shape.mjGEOM_CAPSULE, size=(radius, 0, 0), fromto=(*start, *end), rgba=colour, contype=0,
                      conaffinity=0, **contact)  # fmt: skip

    def hinge(body):
        name, axis, limits, damping, gear = JOINTS[len(spec.joints)]
        joint = body.add_joint(name=name, type=kind.mjJNT_HINGE, axis=axis, range=limits, limited=True, armature=0.004)
        joint.damping[0] = damping
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear[0] = gear
        motor.ctrllimited, motor.ctrlrange = True, (-1, 1)

    scenery(spec)
    world = spec.worldbody
    world.add_geom(name="table", type=shape.mjGEOM_PLANE, pos=(0, 0.5, -0.425), size=(1, 1, 0.1), material="table",
                   **contact)  # fmt: skip
    shoulder = world.add_body(name="shoulder", pos=(0, -0.6, 0))
    for x in (-0.06, 0.06):  # a head with two eyes
        ball(shoulder, 0.05, (x, 0.05, 0.2), metal)
        ball(shoulder, 0.03, (x, 0.09, 0.2), dark)
    rod(shoulder, 0.1, (0, 0, -0.4), (0, 0, 0.2), dark)
    hinge(shoulder)
    lift = shoulder.add_body(name="lift", pos=(0.1, 0, 0))
    rod(lift, 0.1, (0, -0.1, 0), (0, 0.1, 0), dark)
    hinge(lift)
    upper_roll = lift.add_body(name="upper_roll")
    rod(upper_roll, 0.02, (-0.1, 0, 0), (0.1, 0, 0), metal)
    hinge(upper_roll)
    upper_arm = upper_roll.add_body(name="upper_arm")
    rod(upper_arm, 0.06, (0, 0, 0), (0.4, 0, 0), metal)
    elbow = upper_arm.add_body(name="elbow", pos=(0.4, 0, 0))
    rod(elbow, 0.06, (0, -0.02, 0), (0, 0.02, 0), dark)
    hinge(elbow)
    fore_roll = elbow.add_body(name="fore_roll")
    rod(fore_roll, 0.02, (-0.1, 0, 0), (0.1, 0, 0), metal)
    hinge(fore_roll)
    forearm = fore_roll.add_body(name="forearm")
    rod(forearm, 0.05, (0, 0, 0), (0.291, 0, 0), metal)
    wrist = forearm.add_body(name="wrist", pos=(0.321, 0, 0))
    rod(wrist, 0.01, (0, -0.02, 0), (0, 0.02, 0), dark)
    hinge(wrist)
    hand = wrist.add_body(name="hand")
    ball(hand, 0.08, (0.03, 0, 0), glass, collides=1)  # a target that is reached lies in it
    hinge(hand)
    hand.add_site(name="finger", size=(0.05, 0, 0), rgba=(0, 0, 0, 0))
    target = world.add_body(name="target", mocap=True, pos=(0.1, 0.1, 0.1))
    target.add_site(name="target", size=(0.05, 0, 0), rgba=(0.2, 0.7, 0.3, 1))
    return spec


def scenery(spec: mujoco.MjSpec) -> None:
    """Add a sky, a table's material, a light and a camera, which only a video shows."""
    texture, pattern = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=pattern.mjBUILTIN_GRADIENT,
        rgb1=(0.5, 0.6, 0.8), rgb2=(0.9, 0.9, 0.9), width=64, height=384,
    )  # fmt: skip
    spec.add_texture(
        name="table", type=texture.mjTEXTURE_2D, builtin=pattern.mjBUILTIN_CHECKER,
        rgb1=(0.55, 0.5, 0.45), rgb2=(0.6, 0.55, 0.5), width=256, height=256,
    )  # fmt: skip
    table = spec.add_material(name="table", texrepeat=(8, 8), texuniform=False)
    table.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table"
    spec.worldbody.add_light(pos=(0.6, 0.8, 2.5), dir=(-0.2, -0.4, -1), diffuse=(0.8, 0.8, 0.8))
    spec.worldbody.add_camera(name="front", pos=(0.4, 1.35, 0.7), xyaxes=(-0.99, 0.15, 0, -0.06, -0.42, 0.9))


@lw.register
class Reach(lw.Task):
    model = staticmethod(arm)
    frame_skip = 2
    obs = {"position": 7, "velocity": 7, "hand": 3, "error": 3}
    horizon = 75
    memory = REMEMBERED
    # the paper's; its temperature of 5 is an inverse one
    planning = lw.Planning(settings={"horizon": 16, "samples": 30, "temperature": 0.2, "noise": 1.0})
