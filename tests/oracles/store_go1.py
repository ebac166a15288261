"""Store reference data of mjlab's Go1 for the tests: trajectories, reward terms and observations.

mjlab 1.6.0 needs MuJoCo 3.11, so run this script in a separate virtual environment:

    python -m venv mjlab && mjlab/bin/pip install mjlab==1.6.0
    mjlab/bin/python tests/oracles/store_go1.py tests/data/go1_mjlab.npz

Joints are in mjlab's order: legs FR, FL, RR, RL, with hip, thigh and calf for each leg.
"""

import sys
from importlib.metadata import version
from typing import Any

import mjlab.tasks  # noqa: F401 (registers the tasks)
import mujoco
import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
SUBSTEPS, TRAJECTORIES = 200, 4
STEPS, EVERY = 240, 4
TERMS = (
    "track_linear_velocity", "track_angular_velocity", "upright", "pose", "dof_pos_limits", "action_rate_l2",
    "foot_clearance", "foot_swing_height", "foot_slip", "soft_landing",
)  # fmt: skip
MODEL = (
    "body_mass body_pos body_quat body_ipos body_iquat body_inertia body_subtreemass body_invweight0 dof_armature "
    "dof_damping dof_frictionloss dof_invweight0 dof_M0 jnt_axis jnt_pos jnt_range jnt_stiffness jnt_solref jnt_solimp "
    "actuator_gainprm actuator_biasprm actuator_forcerange actuator_gear actuator_acc0 geom_type geom_size geom_pos "
    "geom_quat geom_contype geom_conaffinity geom_condim geom_priority geom_friction geom_solref geom_solimp "
    "geom_solmix geom_margin geom_gap"
).split()
OPTIONS = (
    "timestep integrator cone impratio solver iterations ls_iterations tolerance ls_tolerance ccd_iterations gravity "
    "disableflags enableflags jacobian"
).split()


def names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> list[str]:
    found = [mujoco.mj_id2name(model, kind, i) or "" for i in range(count)]
    return [name.removeprefix("robot/").removesuffix("_joint").replace("_collision", "") for name in found]


def model_arrays(model: mujoco.MjModel) -> dict[str, Any]:
    kind = mujoco.mjtObj
    bodies = names(model, kind.mjOBJ_BODY, model.nbody)
    geoms = names(model, kind.mjOBJ_GEOM, model.ngeom)
    rows = {
        "body": [i for i, name in enumerate(bodies) if name != "terrain"],
        "geom": [i for i, name in enumerate(geoms) if name],
        "actuator": actuators(model),
    }
    out: dict[str, Any] = {f"model/{name}": getattr(model, name) for name in MODEL}
    for name in MODEL:
        out[f"model/{name}"] = out[f"model/{name}"][rows.get(name.partition("_")[0], slice(None))]
    out |= {f"option/{name}": getattr(model.opt, name) for name in OPTIONS}
    return out | {"bodies": [bodies[i] for i in rows["body"]], "geoms": [geoms[i] for i in rows["geom"]]}


def actuators(model: mujoco.MjModel) -> list[int]:
    joints = names(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)[1:]
    own = names(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
    return [own.index(name) for name in joints]


def trajectories(model: mujoco.MjModel) -> dict[str, Any]:
    """Simulate four trajectories: two start in the default pose, and two start tumbling."""
    rng = np.random.default_rng(0)
    home, order = model.key_qpos[0], actuators(model)
    qpos, controls = np.zeros((TRAJECTORIES, SUBSTEPS + 1, 19)), np.zeros((TRAJECTORIES, SUBSTEPS, 12))
    qvel = np.zeros((TRAJECTORIES, 18))
    for i in range(TRAJECTORIES):
        data = mujoco.MjData(model)
        data.qpos = home
        if i >= 2:
            data.qpos[2] += 0.3
            data.qpos[3:7] = rng.normal(size=4)
            data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
            data.qvel = qvel[i] = rng.normal(size=18)
        qpos[i, 0] = data.qpos
        for t in range(SUBSTEPS):
            if t % 4 == 0:
                target = home[7:] + (0.3 if i < 2 else 1.5) * rng.normal(size=12)
            controls[i, t] = target
            data.ctrl[order] = target
            mujoco.mj_step(model, data)
            qpos[i, t + 1] = data.qpos
    return {"trajectory/qpos": qpos, "trajectory/qvel0": qvel, "trajectory/controls": controls}


def judged_states(env: ManagerBasedRlEnv) -> dict[str, Any]:
    torch.manual_seed(0)
    robot, command = env.scene["robot"], env.command_manager.get_term("twist")
    feet = env.scene["feet_ground_contact"]
    swing = env.reward_manager.get_term_cfg("foot_swing_height").func
    rows: dict[str, list[np.ndarray]] = {}

    def keep(name: str, value: torch.Tensor) -> None:
        rows.setdefault(name, []).append(value.detach().cpu().numpy().copy())

    env.reset(seed=0)
    action = torch.zeros(env.num_envs, 12)
    for step in range(STEPS):
        action = 0.8 * action + 0.8 * torch.randn_like(action)
        env.step(action)
        if step % EVERY:
            continue
        kept = {name: value.clone() for name, value in vars(feet._air_time_state).items()}, swing.peak_heights.clone()
        # the step leaves timers and contacts one substep old
        feet.update(env.physics_dt)
        swing.peak_heights[:] = 0.15 * torch.rand_like(swing.peak_heights)
        origins = env.scene.env_origins
        qpos = env.sim.data.qpos.clone()
        qpos[:, :3] -= origins
        keep("qpos", qpos)
        keep("qvel", env.sim.data.qvel)
        keep("command", command.command)
        keep("heading", command.heading_target)
        keep("heading_controlled", command.is_heading_env)
        keep("standing", command.is_standing_env)
        keep("action", env.action_manager.action)
        keep("previous_action", env.action_manager.prev_action)
        keep("encoder_bias", robot.data.encoder_bias)
        keep("air_time", feet.data.current_air_time)
        keep("contact_time", feet.data.current_contact_time)
        keep("force", feet.data.force)
        keep("peak_height", swing.peak_heights)
        keep("target", robot.data.default_joint_pos + env.action_manager.get_term("joint_pos").raw_action
             * env.action_manager.get_term("joint_pos").scale - robot.data.encoder_bias)  # fmt: skip
        env.observation_manager.cfg["actor"].enable_corruption = False
        groups = {name: noiseless(env, name) for name in ("actor", "critic")}
        keep("actor", groups["actor"])
        keep("critic", groups["critic"])
        for term in TERMS:
            own = env.reward_manager.get_term_cfg(term)
            peaks = swing.peak_heights.clone()
            keep(f"term/{term}", own.func(env, **own.params))
            swing.peak_heights[:] = peaks
        for name, value in kept[0].items():
            getattr(feet._air_time_state, name)[:] = value
        swing.peak_heights[:] = kept[1]
        fell = env.termination_manager.get_term_cfg("fell_over")
        keep("fell", fell.func(env, **fell.params))
    return {f"env/{name}": np.concatenate(values) for name, values in rows.items()}


def noiseless(env: ManagerBasedRlEnv, group: str) -> torch.Tensor:
    manager = env.observation_manager
    terms = zip(manager.active_terms[group], manager._group_obs_term_cfgs[group], strict=True)
    return torch.cat([term.func(env, **term.params) for _, term in terms], dim=-1)


def main(path: str) -> None:
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed = 3, 0
    env = ManagerBasedRlEnv(cfg, device="cpu")
    model = env.sim.mj_model
    versions = [f"{name} {version(name)}" for name in ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "torch")]
    stored = model_arrays(model) | trajectories(model) | judged_states(env)
    stored |= {f"weight/{term}": env.reward_manager.get_term_cfg(term).weight for term in TERMS}
    np.savez_compressed(path, script="tests/oracles/store_go1.py", task=TASK, versions=versions, **stored)


if __name__ == "__main__":
    main(sys.argv[1])
