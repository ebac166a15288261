r"""Reach a target that only cameras see. The teacher is a policy of the task reach, which knows the target's position.

    lyceum-warp train reach --algorithm ppo --gamma 0.98 --entropy-coef 0 --nworld 4096 --iterations 250 \
        --device cuda --out runs/reach
    lyceum-warp train examples/seen_reach.py --teacher runs/reach --nworld 1024 --device cuda --out runs/seen-reach
    lyceum-warp eval runs/seen-reach --engine mujoco --device cpu --episodes 64

The student also reads the encoders of the arm's joints, as on a robot.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks import reach
from lyceum_warp.tasks.reach import Params, World


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    lw.put(obs, lw.put(obs, 0, s.qpos), s.qvel)


@wp.func
def observe_teacher(s: World, p: Params, obs: Row[float]):
    reach.observe(s, p, obs)


class SeenReach(reach.Reach):
    obs = {"policy": {"position": 7, "velocity": 7}, "teacher": reach.Reach.obs}
    cameras = (
        lw.Camera("before", pos=(0.05, 1.2, 0.2), lookat=(0.05, 0.0, 0.0), group="before"),
        lw.Camera("above", pos=(0.05, 0.0, 1.2), lookat=(0.05, 0.0, 0.0), group="above"),
    )
    training = lw.Training(
        algorithm="distill", settings={"hidden": (256, 128), "epochs": 4, "gradient_length": 6}, iterations=300
    )
