from lyceum_warp.env.arrays import memory_columns as memory_columns
from lyceum_warp.env.curriculum import (
    Curriculum as Curriculum,
    start_episodes as start_episodes,
)
from lyceum_warp.env.env import (
    Env as Env,
    compile_kernels as compile_kernels,
    make as make,
)
from lyceum_warp.env.openloop import OpenLoop as OpenLoop
from lyceum_warp.env.player import (
    Player as Player,
    Policy as Policy,
    moved as moved,
)
from lyceum_warp.env.probe import Probe as Probe
from lyceum_warp.env.worlds import Worlds as Worlds
