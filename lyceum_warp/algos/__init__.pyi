from lyceum_warp.algos.common.clip_evaluation import (
    ClipResults as ClipResults,
    evaluate_clips as evaluate_clips,
)
from lyceum_warp.algos.common.distributed import (
    Team as Team,
    join as join,
)
from lyceum_warp.algos.common.evaluation import (
    ENDLESS_STEPS as ENDLESS_STEPS,
    Episodes as Episodes,
    evaluate as evaluate,
    evaluation_seed as evaluation_seed,
    evaluation_worlds as evaluation_worlds,
)
from lyceum_warp.algos.common.gate import gate as gate
from lyceum_warp.algos.common.learner import (
    LEARNER_KERNELS as LEARNER_KERNELS,
    METRIC_COLUMN as METRIC_COLUMN,
    STEP_METRIC_COLUMN as STEP_METRIC_COLUMN,
    Iteration as Iteration,
    Learner as Learner,
)
from lyceum_warp.algos.common.networks import LIMIT as LIMIT
from lyceum_warp.algos.common.policy import GaussianPolicy as GaussianPolicy
from lyceum_warp.algos.common.policy_check import check_sizes as check_sizes
from lyceum_warp.algos.common.policy_export import (
    check_export as check_export,
    export_policy as export_policy,
)
from lyceum_warp.algos.common.replay import (
    Replay as Replay,
    Transitions as Transitions,
)
from lyceum_warp.algos.common.rollout_buffer import Rollout as Rollout
from lyceum_warp.algos.common.squashed_policy import SquashedPolicy as SquashedPolicy
from lyceum_warp.algos.common.transfer import (
    EXACT as EXACT,
    Transfer as Transfer,
    physics_text as physics_text,
    simulation as simulation,
    task_physics as task_physics,
    transfer as transfer,
)
from lyceum_warp.algos.common.twin_critic import TwinCritic as TwinCritic
from lyceum_warp.algos.common.value import (
    ValueFunction as ValueFunction,
    value_group as value_group,
)
from lyceum_warp.algos.distill import (
    Demonstrations as Demonstrations,
    Distill as Distill,
    DistillConfig as DistillConfig,
)
from lyceum_warp.algos.npg import NPG as NPG, NPGConfig as NPGConfig
from lyceum_warp.algos.planning.arguments import task_config as task_config
from lyceum_warp.algos.planning.config import MPPIConfig as MPPIConfig
from lyceum_warp.algos.planning.planner import (
    CEM as CEM,
    MPPI as MPPI,
    Planner as Planner,
    PredictiveSampling as PredictiveSampling,
)
from lyceum_warp.algos.planning.updates import (
    PlanSamples as PlanSamples,
    PlanUpdate as PlanUpdate,
)
from lyceum_warp.algos.ppo import PPO as PPO, PPOConfig as PPOConfig
from lyceum_warp.algos.sac import SAC as SAC, SACConfig as SACConfig, action_bounds as action_bounds
