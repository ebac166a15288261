"""Public names of the package; type checkers read this file, and __init__.py loads a name at its first use."""

from lyceum_warp.algos.common.clip_evaluation import ClipResults as ClipResults, evaluate_clips as evaluate_clips
from lyceum_warp.algos.common.evaluation import Episodes as Episodes, evaluate as evaluate
from lyceum_warp.algos.common.gate import gate as gate
from lyceum_warp.algos.common.learner import Iteration as Iteration, Learner as Learner
from lyceum_warp.algos.common.policy import GaussianPolicy as GaussianPolicy
from lyceum_warp.algos.common.policy_export import export_policy as export_policy
from lyceum_warp.algos.common.replay import Replay as Replay, Transitions as Transitions
from lyceum_warp.algos.common.rollout_buffer import Rollout as Rollout
from lyceum_warp.algos.common.squashed_policy import SquashedPolicy as SquashedPolicy
from lyceum_warp.algos.common.transfer import Transfer as Transfer, transfer as transfer
from lyceum_warp.algos.common.twin_critic import TwinCritic as TwinCritic
from lyceum_warp.algos.common.value import ValueFunction as ValueFunction
from lyceum_warp.algos.distill import (
    Demonstrations as Demonstrations,
    Distill as Distill,
    DistillConfig as DistillConfig,
)
from lyceum_warp.algos.npg import NPG as NPG, NPGConfig as NPGConfig
from lyceum_warp.algos.planning.config import MPPIConfig as MPPIConfig
from lyceum_warp.algos.planning.planner import (
    CEM as CEM,
    MPPI as MPPI,
    Planner as Planner,
    PredictiveSampling as PredictiveSampling,
)
from lyceum_warp.algos.planning.updates import PlanSamples as PlanSamples, PlanUpdate as PlanUpdate
from lyceum_warp.algos.ppo import PPO as PPO, PPOConfig as PPOConfig
from lyceum_warp.algos.sac import SAC as SAC, SACConfig as SACConfig
from lyceum_warp.binding.registry import register as register, task_names as task_names
from lyceum_warp.controllers.controller import Controller as Controller, PlanningController as PlanningController
from lyceum_warp.controllers.episode_collector import ControlProgress as ControlProgress
from lyceum_warp.controllers.loop import control as control
from lyceum_warp.controllers.real_time import control_async as control_async
from lyceum_warp.controllers.report import ControlReport as ControlReport, control_report as control_report
from lyceum_warp.controllers.trajectory import Trajectory as Trajectory
from lyceum_warp.core.cameras import Camera as Camera
from lyceum_warp.core.done import Done as Done
from lyceum_warp.core.fields import quat as quat, vec10 as vec10
from lyceum_warp.core.gate import Gate as Gate, Limit as Limit, Verdict as Verdict
from lyceum_warp.core.mirror import Mirror as Mirror
from lyceum_warp.core.model_files import (
    ModelFile as ModelFile,
    gymnasium_model as gymnasium_model,
    gymnasium_robotics_model as gymnasium_robotics_model,
    menagerie_model as menagerie_model,
    package_model as package_model,
    playground_model as playground_model,
)
from lyceum_warp.core.objects import (
    Objects as Objects,
    mesh as mesh,
    myosuite_objects as myosuite_objects,
    shape as shape,
)
from lyceum_warp.core.options import EnvOptions as EnvOptions, PhysicsOptions as PhysicsOptions
from lyceum_warp.core.task import (
    Planning as Planning,
    Row as Row,
    Task as Task,
    Training as Training,
    act as act,
    actuator as actuator,
    actuators as actuators,
    bodies as bodies,
    body as body,
    camera as camera,
    ctrl as ctrl,
    dof as dof,
    dofs as dofs,
    equality as equality,
    from_model as from_model,
    geom as geom,
    geoms as geoms,
    joint as joint,
    joints as joints,
    lasting_memory as lasting_memory,
    memory as memory,
    mocap as mocap,
    part as part,
    qpos as qpos,
    qposes as qposes,
    sensor as sensor,
    sensors as sensors,
    site as site,
    sites as sites,
    tendon as tendon,
)
from lyceum_warp.env.curriculum import Curriculum as Curriculum
from lyceum_warp.env.env import Env as Env, make as make
from lyceum_warp.env.openloop import OpenLoop as OpenLoop
from lyceum_warp.fitting.excitation import excitation as excitation
from lyceum_warp.fitting.fit import fit as fit
from lyceum_warp.fitting.parameters import Parameter as Parameter
from lyceum_warp.fitting.result import Fit as Fit
from lyceum_warp.kernels.ground import (
    follow_walk as follow_walk,
    ground_distance as ground_distance,
    ground_height as ground_height,
    ground_normal as ground_normal,
    height_scan as height_scan,
    next_level as next_level,
    on_ground as on_ground,
    start_on_terrain as start_on_terrain,
)
from lyceum_warp.kernels.put import put as put, put_upright as put_upright
from lyceum_warp.kernels.random import normal as normal, uniform as uniform
from lyceum_warp.kernels.rewards import (
    Sigmoid as Sigmoid,
    all_inside as all_inside,
    grasp_terms as grasp_terms,
    inside as inside,
    sum_squares as sum_squares,
    tolerance as tolerance,
)
from lyceum_warp.kernels.rotations import (
    quat_angle as quat_angle,
    quat_difference as quat_difference,
    quat_from_axis_angle as quat_from_axis_angle,
    quat_from_euler as quat_from_euler,
    quat_from_rotvec as quat_from_rotvec,
    quat_inverse as quat_inverse,
    quat_mul as quat_mul,
    quat_random as quat_random,
    quat_rotate as quat_rotate,
    quat_rotate_inverse as quat_rotate_inverse,
    quat_to_euler as quat_to_euler,
    quat_to_mat as quat_to_mat,
    quat_to_rotvec as quat_to_rotvec,
)
from lyceum_warp.kernels.velocities import body_velocity as body_velocity
from lyceum_warp.models.actuators import follow_velocity as follow_velocity
from lyceum_warp.models.terrain import Terrain as Terrain, height_field as height_field, scan_grid as scan_grid
from lyceum_warp.motions.clips import Clips as Clips, load_clips as load_clips
from lyceum_warp.training.callbacks import (
    Callback as Callback,
    TransferTest as TransferTest,
    Videos as Videos,
)
from lyceum_warp.training.gating import PassGate as PassGate
from lyceum_warp.training.loop import train as train
from lyceum_warp.training.runs.folder import (
    Run as Run,
    load as load,
    load_curriculum as load_curriculum,
    load_value as load_value,
)
from lyceum_warp.training.runs.pretrained_runs import pretrained_run as pretrained_run
from lyceum_warp.training.seeds import SeedRun as SeedRun, train_seeds as train_seeds
from lyceum_warp.training.stopping import Minutes as Minutes, TargetReturn as TargetReturn
from lyceum_warp.training.trackers import TensorBoard as TensorBoard, WandB as WandB
from lyceum_warp.tuning.search import Tuning as Tuning, tune as tune
from lyceum_warp.viewer.show import view as view
from lyceum_warp.viz.page import show as show

from . import terms as terms
from .models import walkers as walkers
from .motions import clip_tables as clip_tables

__version__: str
