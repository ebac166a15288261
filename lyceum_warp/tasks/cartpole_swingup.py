"""CartpoleSwingup: swing a pole up and balance it (the task of dm_control, with Lyceum's reward)."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class Params:
    dt: float
    reset_noise_scale: float = 0.01


@wp.func
def closeness(x: float, margin: float, value_at_margin: float) -> float:
    """1 at zero, falling as a parabola to value_at_margin at the margin, and never below 0."""
    scaled = x / margin
    return wp.max(0.0, 1.0 - (1.0 - value_at_margin) * scaled * scaled)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = wp.cos(s.qpos[1])
    obs[2] = wp.sin(s.qpos[1])
    obs[3] = s.qvel[0]
    obs[4] = s.qvel[1]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    upright = (wp.cos(s1.qpos[1]) + 1.0) / 2.0
    centred = (1.0 + closeness(s1.qpos[0], 2.0, 0.1)) / 2.0
    small_control = (4.0 + closeness(action[0], 1.0, 0.0)) / 5.0
    small_velocity = (1.0 + closeness(s1.qvel[1], 5.0, 0.1)) / 2.0
    return upright * centred * small_control * small_velocity


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.cos(s.qpos[1])


@wp.func
def initialize(s: World, p: Params):
    s.qpos[1] = wp.pi


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] += p.reset_noise_scale * lw.normal(rng)
        s.qvel[i] += p.reset_noise_scale * lw.normal(rng)


def cartpole() -> mujoco.MjSpec:
    """A cart of 1 kg on a rail and a pole of 0.1 kg and 1 m, without contacts."""
    spec = mujoco.MjSpec()
    spec.modelname = "cartpole"
    spec.option.timestep = 0.01
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    geom, joint = mujoco.mjtGeom, mujoco.mjtJoint
    world = spec.worldbody
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.5, 0.6, 0.8), rgb2=(0.9, 0.9, 0.9), width=64, height=384,
    )  # fmt: skip
    world.add_light(pos=(0, 0, 6))
    world.add_camera(name="side", pos=(0, -4, 1), quat=(2**-0.5, 2**-0.5, 0, 0))
    world.add_geom(type=geom.mjGEOM_CAPSULE, fromto=(-2, 0.07, 1, 2, 0.07, 1), size=(0.02, 0, 0))
    world.add_geom(type=geom.mjGEOM_CAPSULE, fromto=(-2, -0.07, 1, 2, -0.07, 1), size=(0.02, 0, 0))
    cart = world.add_body(name="cart", pos=(0, 0, 1))
    slider = cart.add_joint(name="slider", type=joint.mjJNT_SLIDE, axis=(1, 0, 0), range=(-1.8, 1.8), limited=True)
    slider.solref_limit = (0.08, 1)
    slider.damping[0] = 5e-4
    cart.add_geom(type=geom.mjGEOM_BOX, size=(0.2, 0.15, 0.1), mass=1, rgba=(0.3, 0.5, 0.7, 1))
    pole = cart.add_body(name="pole")
    hinge = pole.add_joint(name="hinge", type=joint.mjJNT_HINGE, axis=(0, 1, 0))
    hinge.damping[0] = 2e-6
    pole.add_geom(type=geom.mjGEOM_CAPSULE, fromto=(0, 0, 0, 0, 0, 1), size=(0.045, 0, 0), mass=0.1,
                  rgba=(0.7, 0.5, 0.3, 1))  # fmt: skip
    motor = spec.add_actuator(name="slide", target="slider", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.gear[0] = 10
    motor.ctrllimited, motor.ctrlrange = True, (-1, 1)
    return spec


@lw.register
class CartpoleSwingup(lw.Task):
    model = staticmethod(cartpole)
    obs = {"cart_position": 1, "pole_direction": 2, "cart_velocity": 1, "pole_velocity": 1}
    planning = lw.Planning(settings={"horizon": 100})
