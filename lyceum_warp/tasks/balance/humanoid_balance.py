"""HumanoidStand: Gymnasium's humanoid stands, and steps to keep its balance when it is pushed.

Actions are offsets of the joints' targets from a pose with bent knees. The motors act as servos at the control rate,
within Gymnasium's torque limits. The feet are spheres, so the robot must step and swing its body to keep its balance.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.balance import balancing
from lyceum_warp.tasks.balance.balancing import World

LEG = ("hip_x", "hip_z", "hip_y", "knee")
ARM = ("shoulder1", "shoulder2", "elbow")
JOINTS = ("abdomen_z", "abdomen_y", "abdomen_x", *(f"{side}_{name}" for name_of in (LEG, ARM)
          for side in ("right", "left") for name in name_of))  # fmt: skip


@wp.struct
class Params(balancing.Params):
    joint_qpos: wp.array[int] = lw.qposes(*JOINTS)
    joint_dof: wp.array[int] = lw.dofs(*JOINTS)
    motors: wp.array[int] = lw.actuators(*JOINTS)
    default_pose: wp.array[float] = [*3 * [0.0], *2 * [-0.05, 0.0, -0.3, -0.65], *2 * [0.0, 0.0, -0.8]]  # rad
    action_scale: wp.array[float] = [*3 * [0.5], *2 * [0.5, 0.5, 1.0, 1.0], *6 * [1.0]]  # rad
    target_height: float = 1.22  # of the torso, m
    least_height: float = 0.8
    start_height: float = 1.25
    # servos
    stiffness: wp.array[float] = [*3 * [80.0], *2 * [60.0, 60.0, 150.0, 100.0], *6 * [10.0]]  # N m / rad
    damping: wp.array[float] = [*3 * [0.0], *2 * [0.0, 0.0, 0.0, 4.0], *6 * [0.0]]  # N m s / rad
    gear: wp.array[float] = lw.from_model(lambda model, p: [float(model.actuator_gear[i, 0]) for i in p.motors])


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.motors.shape[0]):
        target = p.default_pose[j] + p.action_scale[j] * action[j]
        q, qdot = s.qpos[p.joint_qpos[j]], s.qvel[p.joint_dof[j]]
        torque = terms.servo_torque(target, q, qdot, p.stiffness[j], p.damping[j])
        ctrl[p.motors[j]] = torque / p.gear[j]


@lw.register
class HumanoidStand(balancing.Balance):
    model, frame_skip, horizon = "humanoid.xml", 5, 1333  # 20 s
    obs, actions = {"position": 22, "velocity": 23}, {"joint_target": "motors"}
    physics = {
        "fast": lw.PhysicsOptions(integrator="implicitfast", timestep=0.015, frame_skip=1),
        "discrete": lw.PhysicsOptions(integrator="discrete", timestep=0.015, frame_skip=1),
    }
    planning = lw.Planning(
        settings=dict(horizon=40, samples=24, knots=8, noise=0.15, temperature=0.0075), options={"physics": "fast"}
    )


@lw.register
class HumanoidWalk(HumanoidStand):
    """Gymnasium's humanoid walks forward, and keeps its balance when it is pushed."""

    params, evaluate = {"forward_speed": 0.8}, balancing.evaluate_distance


@wp.func
def lie_down(s: World, p: Params):
    s.qpos[2] = 0.15


@wp.func
def turn_over(s: World, p: Params, rng: Row[wp.uint32]):
    """Start on the back or on the front."""
    angle = wp.where(lw.uniform(rng, 0.0, 1.0) < 0.5, -0.5 * wp.pi, 0.5 * wp.pi)
    lw.put(s.qpos, 3, lw.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), angle + lw.uniform(rng, -0.1, 0.1)))
    for j in range(p.joint_qpos.shape[0]):
        s.qpos[p.joint_qpos[j]] += lw.uniform(rng, -p.start_noise, p.start_noise)


@wp.func
def stands(s: World, p: Params) -> bool:
    return s.qpos[2] > 1.1


@lw.register
class HumanoidGetUp(HumanoidStand):
    """Gymnasium's humanoid gets up from its back or its front, and succeeds if it stands for a second."""

    params = {"push_times": [15.0]}
    initialize, randomize, success = lie_down, turn_over, stands
    terminations, success_steps = (), 67
    rewards = HumanoidStand.rewards | {
        "height_l2": -30.0,
        "capture_l2": -8.0,
        "velocity_l2": -0.5,
        "turned": 0.0,
        "pose_l2": -0.1,
        "joint_velocity_l2": 0.0,
    }
    planning = lw.Planning(
        settings=dict(horizon=40, samples=24, knots=5, noise=0.3, temperature=0.02), options={"physics": "fast"}
    )
