"""Walk on rough ground by two depth cameras. The teacher is the policy of go1_rough_velocity, which scans the ground.

    lyceum-warp train examples/go1_depth.py --teacher go1_rough_velocity --device cuda --out runs/depth
    lyceum-warp eval runs/depth --engine mujoco --physics exact --memory level=5

The cameras are on the trunk and see the ground before and behind the robot. A GRU remembers what is below it. The
student also reads the encoders and the inertial sensor, but neither the linear velocity nor the scan.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.velocity import go1_rough, rough, student, walking


@wp.func
def observe(s: walking.World, p: walking.Params, obs: student.Student, rng: Row[wp.uint32]):
    student.observe(s, p, obs, rng)


@wp.func
def observe_teacher(s: rough.World, p: rough.Params, obs: rough.Policy):
    student.observe_teacher(s, p, obs)
    lw.height_scan(obs.height_scan, p.terrain, p.scan, rough.base(s), terms.orientation(s.qpos))


def depth(name: str, side: float) -> lw.Camera:
    pos, lookat = (side * 0.31, 0.0, 0.03), (side * 0.71, 0.0, -0.3)
    return lw.Camera(name, 32, 32, "depth", name, pos, lookat, body="trunk", fovy=80.0)


class Go1Depth(go1_rough.Go1RoughVelocity):
    cameras = (depth("ahead", 1.0), depth("behind", -1.0))
    training = lw.Training(
        algorithm="distill", settings={"recurrent": 256, "epochs": 4, "gradient_length": 12}, iterations=100,
        physics="coarse",
    )  # fmt: skip
