from lyceum_warp.controllers.batch import policy_episodes as policy_episodes
from lyceum_warp.controllers.checked_controller import (
    CheckedController as CheckedController,
    accepts as accepts,
    signature_of as signature_of,
)
from lyceum_warp.controllers.controller import (
    Controller as Controller,
    PlanningController as PlanningController,
)
from lyceum_warp.controllers.episode_collector import ControlProgress as ControlProgress
from lyceum_warp.controllers.loop import control as control
from lyceum_warp.controllers.real_time import control_async as control_async
from lyceum_warp.controllers.real_time_setting import (
    RealTimeChoice as RealTimeChoice,
    RealTimeSetting as RealTimeSetting,
    choose_setting as choose_setting,
    planning_time as planning_time,
)
from lyceum_warp.controllers.report import (
    ControlReport as ControlReport,
    control_report as control_report,
)
from lyceum_warp.controllers.saved_episodes import (
    check_episode as check_episode,
    episode_env as episode_env,
    load_episodes as load_episodes,
)
from lyceum_warp.controllers.trajectory import (
    Trajectory as Trajectory,
    source as source,
)
