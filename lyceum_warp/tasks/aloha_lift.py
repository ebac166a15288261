"""AlohaLift: lift a pot by its two handles with two arms (robot and pot from mujoco_warp's test data).

Meshes are visual only. Collisions use simple shapes in the task's MJCF file, and capsules fitted to the arms. The arms
do not collide with each other. Actions are the velocities at which the targets of the position servos move. Success:
the pot has been above the goal height for ten consecutive steps.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    # 6 joints and 2 fingers of the left arm, then of the right; position and quaternion of the pot; the lid
    qpos: Row[float]
    qvel: Row[float]
    act: Row[float]  # the servo targets of both arms
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    site_xpos: Row[wp.vec3]
    site_xmat: Row[wp.mat33]


@wp.struct
class Params:
    goal_height: float = 0.1
    rest_height: float = 0.0658  # the pot's height when it rests on the table, m
    place: wp.vec3 = wp.vec3(0.03, 0.03, 0.25)  # the initial pose's bounds: x, y (m) and yaw (rad)
    pot: int = lw.body("partnet_100015/")
    left_grip: int = lw.site("lift/left_grip")
    right_grip: int = lw.site("lift/right_grip")
    left_handle: int = lw.site("lift/left_handle")
    right_handle: int = lw.site("lift/right_handle")


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
def evaluate(s: World, p: Params) -> float:  # the height of the pot above the table
    return s.xpos[p.pot][2] - p.rest_height


@wp.func
def arm(s: World, grip: int, handle: int, finger: int) -> wp.vec4:
    near, reach, grasp = lw.grasp_terms(wp.length(s.site_xpos[grip] - s.site_xpos[handle]), s.qpos[finger], 0.015)
    # the fingers slide along the gripper's y axis, and the handle's bar is parallel to the pot's x axis;
    # the grip is best if these two axes are perpendicular
    orient = 1.0 - wp.abs(wp.dot(s.site_xmat[grip][:, 1], s.site_xmat[handle][:, 0]))
    return wp.vec4(reach, orient, grasp, near)


@wp.func
def terms(s: World, p: Params) -> wp.vec4:
    left, right = arm(s, p.left_grip, p.left_handle, 6), arm(s, p.right_grip, p.right_handle, 14)
    mean, upright = 0.5 * (left + right), wp.max(s.xmat[p.pot][2, 2], 0.0)
    lift = wp.min(left[3], right[3]) * upright * wp.clamp(evaluate(s, p) / (1.5 * p.goal_height), 0.0, 1.0)
    return wp.vec4(mean[0], mean[1], mean[2], lift)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(s1, p), wp.vec4(1.0, 0.5, 1.0, 4.0)) - 0.005 * lw.sum_squares(action)


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) > p.goal_height


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    d = lw.uniform(rng, -p.place, p.place)
    lw.put_upright(s.qpos, 16, wp.vec3(d[0], d[1], p.rest_height), 0.5 * wp.pi + d[2])  # each arm faces a handle


@lw.register
class AlohaLift(lw.Task):
    model = lw.package_model("mujoco_warp", "test_data/aloha_pot/scene.xml", install="mujoco-warp>=4.0,<5")
    keyframe = "start"
    frame_skip, horizon, success_steps = 8, 150, 10
    obs = {"position": 16, "velocity": 22, "target": 14, "pot": 3, "pot_axes": 9, "handles_from_grips": 6}
    metrics, action_range = ("reach", "orient", "grasp", "lift"), (-1.0, 1.0)
    # planning with half the substeps is 1.9 times as fast; with longer substeps, contacts are softer and grasps fail
    physics = {"fast": lw.PhysicsOptions(frame_skip=4, timestep=0.01)}
    planning = lw.Planning(settings=dict(horizon=16, samples=128, temperature=0.5, noise=0.6, include_plan=False))

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for servo in spec.actuators:
            lw.follow_velocity(servo, 0.1 if servo.name.endswith("gripper") else 1.0)  # m/s or rad/s
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
            if geom.classname.name == "collision" and geom.name != "table":
                geom.type, geom.conaffinity = mujoco.mjtGeom.mjGEOM_CAPSULE, 1
            elif geom.name.startswith("partnet"):
                geom.rgba = (0.75, 0.77, 0.8, 1.0)
        spec.camera("collaborator_pov").mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACK
        for light in spec.lights:
            light.castshadow = False  # without a GPU, shadows make rendering 17 times slower
        child = lw.package_model("lyceum_warp", "tasks/aloha_lift.xml").spec()
        for part in child.worldbody.bodies:
            spec.body(part.name).add_frame().attach_body(part, "lift/", "")
        arm = [0, -1.05, 1.06, 0, 0.78, 1.57, 0.035, 0.035]  # the grippers are beside the handles
        pot = [0, 0, 0.0658, 0.7071068, 0, 0, 0.7071068, 0]
        spec.add_key(name="start", qpos=arm + arm + pot, act=2 * arm[:7])
