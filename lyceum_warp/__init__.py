"""Batched MuJoCo worlds for robot learning: one task source, two engines, arrays shared with torch.

The package imports torch, Warp and MuJoCo only when a name that needs them is first used (PEP 562).
"""

import importlib
from typing import TYPE_CHECKING, Any

# fmt: off
# isort: off
if TYPE_CHECKING:
    import lyceum_warp.terms
    import lyceum_warp.walkers  # noqa: F401
    from lyceum_warp.model_actuators import follow_velocity
    from lyceum_warp.algos.evaluation import Episodes, evaluate
    from lyceum_warp.algos.learner import Iteration, Learner
    from lyceum_warp.algos.mppi_config import MPPIConfig
    from lyceum_warp.algos.npg import NPG
    from lyceum_warp.algos.npg_config import NPGConfig
    from lyceum_warp.algos.plan_update import PlanSamples, PlanUpdate
    from lyceum_warp.algos.planner import CEM, MPPI, Planner, PredictiveSampling
    from lyceum_warp.algos.policy import GaussianPolicy
    from lyceum_warp.algos.policy_export import export_policy
    from lyceum_warp.algos.ppo import PPO
    from lyceum_warp.algos.ppo_config import PPOConfig
    from lyceum_warp.algos.replay import Replay, Transitions
    from lyceum_warp.algos.rollout_buffer import Rollout
    from lyceum_warp.algos.sac import SAC
    from lyceum_warp.algos.sac_config import SACConfig
    from lyceum_warp.algos.squashed_policy import SquashedPolicy
    from lyceum_warp.algos.transfer import Transfer, transfer
    from lyceum_warp.algos.twin_critic import TwinCritic
    from lyceum_warp.algos.value import ValueFunction
    from lyceum_warp.binding.registry import register, task_names
    from lyceum_warp.controllers.control_report import ControlReport, control_report
    from lyceum_warp.controllers.controller import Controller, PlanningController
    from lyceum_warp.controllers.episode_collector import ControlProgress
    from lyceum_warp.controllers.loop import control
    from lyceum_warp.controllers.real_time import control_async
    from lyceum_warp.controllers.trajectory import Trajectory
    from lyceum_warp.done import Done
    from lyceum_warp.env import Env, make
    from lyceum_warp.fields import quat, vec10
    from lyceum_warp.kernels.ground import (
        follow_walk, ground_distance, ground_height, ground_normal, height_scan, next_level, on_ground,
        start_on_terrain)
    from lyceum_warp.kernels.random import normal, uniform
    from lyceum_warp.kernels.rotations import (
        quat_angle, quat_difference, quat_from_axis_angle, quat_from_euler, quat_from_mat, quat_from_rotvec,
        quat_inverse, quat_mul, quat_random, quat_rotate, quat_rotate_inverse, quat_to_euler, quat_to_mat,
        quat_to_rotvec)
    from lyceum_warp.kernels.task_helpers import (
        Sigmoid, all_inside, angle_between, body_velocity, grasp_terms, inside, local_velocity, put, put_upright,
        sum_squares, tolerance)
    from lyceum_warp.mirror import Mirror
    from lyceum_warp.model_files import (
        ModelFile, gymnasium_model, gymnasium_robotics_model, menagerie_model, package_model, playground_model)
    from lyceum_warp.openloop import OpenLoop
    from lyceum_warp.options import EnvOptions, PhysicsOptions
    from lyceum_warp.runs.folder import load, load_value
    from lyceum_warp.runs.pretrained_runs import pretrained_run
    from lyceum_warp.task import (
        Planning, Row, Task, Training, act, actuator, actuators, bodies, body, camera, ctrl, dof, dofs, equality,
        from_model, geom, geoms, joint, joints, lasting_memory, memory, mocap, part, qpos, qposes, sensor, sensors,
        site, sites, tendon)
    from lyceum_warp.terrain import Terrain, height_field, scan_grid
    from lyceum_warp.training import train
    from lyceum_warp.tuning.search import Tuning, tune
    from lyceum_warp.viewer.show import view

__all__ = [
    "CEM", "MPPI", "NPG", "PPO", "SAC", "ControlProgress", "ControlReport", "Controller", "Done", "Env", "EnvOptions",
    "Episodes", "GaussianPolicy", "Iteration", "Learner", "MPPIConfig", "Mirror", "ModelFile", "NPGConfig", "OpenLoop",
    "PPOConfig", "PhysicsOptions", "PlanSamples", "PlanUpdate", "Planner", "Planning", "PlanningController",
    "PredictiveSampling", "Replay", "Rollout", "Row", "SACConfig", "Sigmoid", "SquashedPolicy", "Task",
    "Terrain", "Training", "Trajectory", "Transfer", "Transitions", "Tuning", "TwinCritic", "ValueFunction", "act",
    "actuator", "actuators", "all_inside", "angle_between", "bodies", "body", "body_velocity", "camera", "control",
    "control_async", "control_report", "ctrl", "dof", "dofs", "equality", "evaluate", "export_policy",
    "follow_velocity", "follow_walk", "from_model", "geom", "geoms", "grasp_terms", "ground_distance", "ground_height",
    "ground_normal", "gymnasium_model", "gymnasium_robotics_model", "height_field", "height_scan", "inside", "joint",
    "joints", "lasting_memory", "load", "load_value", "local_velocity", "make", "memory", "menagerie_model", "mocap",
    "next_level", "normal", "on_ground", "package_model", "part", "playground_model", "pretrained_run", "put",
    "put_upright", "qpos", "qposes", "quat", "quat_angle", "quat_difference", "quat_from_axis_angle",
    "quat_from_euler", "quat_from_mat", "quat_from_rotvec", "quat_inverse", "quat_mul", "quat_random",
    "quat_rotate", "quat_rotate_inverse", "quat_to_euler", "quat_to_mat", "quat_to_rotvec", "register", "scan_grid",
    "sensor", "sensors", "site", "sites", "start_on_terrain", "sum_squares", "task_names", "tendon", "tolerance",
    "train", "transfer", "tune", "uniform",
    "vec10", "view"]

_NAMES = {
    "model_actuators": "follow_velocity",
    "algos.evaluation": "Episodes evaluate",
    "algos.learner": "Iteration Learner",
    "algos.mppi_config": "MPPIConfig",
    "algos.npg": "NPG",
    "algos.npg_config": "NPGConfig",
    "algos.plan_update": "PlanSamples PlanUpdate",
    "algos.planner": "CEM MPPI Planner PredictiveSampling",
    "algos.policy": "GaussianPolicy",
    "algos.policy_export": "export_policy",
    "algos.ppo": "PPO",
    "algos.ppo_config": "PPOConfig",
    "algos.replay": "Replay Transitions",
    "algos.rollout_buffer": "Rollout",
    "algos.sac": "SAC",
    "algos.sac_config": "SACConfig",
    "algos.squashed_policy": "SquashedPolicy",
    "algos.transfer": "Transfer transfer",
    "algos.twin_critic": "TwinCritic",
    "algos.value": "ValueFunction",
    "binding.registry": "register task_names",
    "controllers.control_report": "ControlReport control_report",
    "controllers.controller": "Controller PlanningController",
    "controllers.episode_collector": "ControlProgress",
    "controllers.loop": "control",
    "controllers.real_time": "control_async",
    "controllers.trajectory": "Trajectory",
    "done": "Done",
    "env": "Env make",
    "fields": "quat vec10",
    "kernels.ground":
        "follow_walk ground_distance ground_height ground_normal height_scan next_level on_ground start_on_terrain",
    "kernels.random": "normal uniform",
    "kernels.rotations":
        "quat_angle quat_difference quat_from_axis_angle quat_from_euler quat_from_mat quat_from_rotvec quat_inverse "
        "quat_mul quat_random quat_rotate quat_rotate_inverse quat_to_euler quat_to_mat quat_to_rotvec",
    "kernels.task_helpers":
        "Sigmoid all_inside angle_between body_velocity grasp_terms inside local_velocity put put_upright sum_squares "
        "tolerance",
    "mirror": "Mirror",
    "model_files":
        "ModelFile gymnasium_model gymnasium_robotics_model menagerie_model package_model "
        "playground_model",
    "openloop": "OpenLoop",
    "options": "EnvOptions PhysicsOptions",
    "runs.folder": "load load_value",
    "runs.pretrained_runs": "pretrained_run",
    "task":
        "Planning Row Task Training act actuator actuators bodies body camera ctrl dof dofs equality from_model geom "
        "geoms joint joints lasting_memory memory mocap part qpos qposes sensor sensors site sites tendon",
    "terrain": "Terrain height_field scan_grid",
    "training": "train",
    "tuning.search": "Tuning tune",
    "viewer.show": "view",
}
"""Public names by module."""
# isort: on
# fmt: on

__version__ = "0.2.0"
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name in ("terms", "walkers"):  # users write lw.terms.NAME, not lw.NAME
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "terms", "walkers"})
