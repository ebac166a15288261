"""G1Stand: a Unitree G1 with a rigid upper body steps in place, and keeps its balance when it is pushed.

The leg joints' targets follow a gait clock and lift the feet. Actions are added to these targets. With zero actions,
the robot steps in place and falls after about a second. A planner does not need to find the gait, but it must keep the
robot upright. The servos have the gains of unitree_rl_gym, which also keeps waist and arms rigid. A substep would take
twice as long with the upper body's 17 joints and the legs' dry friction.
"""

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, walkers
from lyceum_warp.tasks.balance import balancing
from lyceum_warp.tasks.balance.balancing import World

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
LEGS = [f"{side}_{joint}_joint" for side in ("left", "right") for joint in LEG]
GAINS = {"hip": (100.0, 2.0), "knee": (150.0, 4.0), "ankle": (40.0, 2.0)}  # N m / rad, N m s / rad


@wp.struct
class Params(balancing.Params):
    joint_qpos: wp.array[int] = lw.qposes(*LEGS)
    joint_dof: wp.array[int] = lw.dofs(*LEGS)
    motors: wp.array[int] = lw.actuators(*LEGS)
    default_pose: wp.array[float] = 2 * [-0.312, 0.0, 0.0, 0.669, -0.363, 0.0]  # rad
    action_scale: wp.array[float] = 2 * [1.0, 0.5, 0.5, 1.0, 0.5, 0.25]  # rad
    target_height: float = 0.75  # of the pelvis, m
    start_height: float = 0.755
    # gait
    gait_frequency: float = 1.25  # Hz
    stance_share: float = 0.6  # fraction of a cycle for which a foot is on the ground
    swing: wp.array[float] = 2 * [-0.3, 0.0, 0.0, 0.6, -0.3, 0.0]  # largest change of the targets in a swing, rad


@wp.func
def target(joint: int, time: float, p: Params) -> float:
    """Return the target angle of a joint if its action is 0, in rad."""
    cycles = time * p.gait_frequency + 0.5 * float(joint // 6)  # the feet are half a cycle apart
    progress = (cycles - wp.floor(cycles) - p.stance_share) / (1.0 - p.stance_share)
    lift = wp.where(progress > 0.0, wp.sin(wp.pi * progress), 0.0)
    return p.default_pose[joint] + lift * p.swing[joint]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.motors.shape[0]):
        ctrl[p.motors[j]] = target(j, s.time, p) + p.action_scale[j] * action[j]


@wp.func
def pose_l2(s1: World, p: Params) -> float:
    total = float(0.0)
    for j in range(p.joint_qpos.shape[0]):
        error = s1.qpos[p.joint_qpos[j]] - target(j, s1.time, p)
        total += error * error
    return total


@lw.register
class G1Stand(balancing.Balance):
    model = lw.playground_model("locomotion/g1/xmls/scene_mjx_feetonly_flat_terrain.xml")
    frame_skip, horizon = 4, 1000  # 20 s
    obs, actions = {"position": 17, "velocity": 18}, {"joint_target": "motors"}
    physics = {
        "fast": lw.PhysicsOptions(
            timestep=0.01, frame_skip=2, solver={"iterations": 4, "ls_iterations": 5}, discardvisual=True
        ),
        "discrete": lw.PhysicsOptions(
            integrator="discrete", timestep=0.02, frame_skip=1, solver={"iterations": 4, "ls_iterations": 5},
            discardvisual=True,
        ),
    }  # fmt: skip
    planning = lw.Planning(
        settings=dict(horizon=30, samples=12, knots=6, noise=0.08, temperature=0.0075), options={"physics": "fast"}
    )

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Make the upper body rigid in the pose of the keyframe knees_bent, and set the legs' gains."""
        walkers.prepare_walker(spec, ("left_foot", "right_foot"), timestep=0.005, iterations=(10, 10))
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model = spec.copy().compile()
        pose = model.key("knees_bent").qpos
        upper_joints = [joint for joint in spec.joints if joint.name not in LEGS][1:]
        servos = [servo for servo in spec.actuators if servo.target not in LEGS]
        hands = [pair for pair in spec.pairs if "hand" in pair.geomname1 + pair.geomname2]
        for element in (*spec.sensors, *spec.keys, *servos, *hands):
            spec.delete(element)
        for body in spec.bodies:  # most meshes have two visual geoms
            meshes = [geom.meshname for geom in body.geoms]
            for i, geom in enumerate(body.geoms):
                if geom.meshname and geom.meshname in meshes[:i]:
                    spec.delete(geom)
        for joint in upper_joints:
            turn, turned = np.zeros(4), np.zeros(4)
            mujoco.mju_axisAngle2Quat(turn, joint.axis, pose[model.joint(joint.name).qposadr[0]])
            mujoco.mju_mulQuat(turned, joint.parent.quat, turn)
            joint.parent.quat = turned
            spec.delete(joint)
        spec.compiler.fusestatic = True
        for servo in spec.actuators:
            stiffness, damping = next(gains for part, gains in GAINS.items() if part in servo.target)
            servo.set_to_position(kp=stiffness, kv=0.0)
            joint = spec.joint(servo.target)
            joint.damping, joint.frictionloss = [damping, 0.0, 0.0], 0.0


@lw.register
class G1Walk(G1Stand):
    """A Unitree G1 with a rigid upper body walks forward, and keeps its balance when it is pushed."""

    params, evaluate = {"forward_speed": 0.6}, balancing.evaluate_distance
