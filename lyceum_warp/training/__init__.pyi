from lyceum_warp.training.callbacks import (
    Callback as Callback,
    TransferTest as TransferTest,
    Videos as Videos,
)
from lyceum_warp.training.comparison import (
    RunCurve as RunCurve,
    RunGroup as RunGroup,
    comparison_figure as comparison_figure,
    group_runs as group_runs,
    mean_curve as mean_curve,
    read_curve as read_curve,
    read_curves as read_curves,
    row_seconds as row_seconds,
)
from lyceum_warp.training.curve import learning_curve as learning_curve
from lyceum_warp.training.gating import PassGate as PassGate
from lyceum_warp.training.loop import train as train
from lyceum_warp.training.report import html_page as html_page, write_report as write_report
from lyceum_warp.training.runs.checkpoints import (
    network_of as network_of,
    read_checkpoint as read_checkpoint,
)
from lyceum_warp.training.runs.choice import (
    AUTO as AUTO,
    EPISODES as EPISODES,
    Choice as Choice,
    choose_policy as choose_policy,
    stored_scores as stored_scores,
)
from lyceum_warp.training.runs.configuration import (
    ALGORITHMS as ALGORITHMS,
    Configuration as Configuration,
    learned_physics as learned_physics,
    learner_classes as learner_classes,
    saved_networks as saved_networks,
)
from lyceum_warp.training.runs.folder import (
    Run as Run,
    load as load,
    load_curriculum as load_curriculum,
    load_value as load_value,
    runs_in as runs_in,
)
from lyceum_warp.training.runs.pretrained_runs import (
    pretrained_run as pretrained_run,
    pretrained_tasks as pretrained_tasks,
    pretrained_text as pretrained_text,
)
from lyceum_warp.training.runs.task_copy import (
    json_value as json_value,
    note_changes as note_changes,
    run_env as run_env,
    table_rows as table_rows,
    task_copy as task_copy,
)
from lyceum_warp.training.seeds import SeedRun as SeedRun, flag_words as flag_words, train_seeds as train_seeds
from lyceum_warp.training.stopping import (
    Minutes as Minutes,
    TargetReturn as TargetReturn,
)
from lyceum_warp.training.trackers import TensorBoard as TensorBoard, WandB as WandB
