"""Compile kernels ahead of time: lyceum-warp warmup."""

import dataclasses
import time

import tyro

from lyceum_warp.algos.npg import NPG
from lyceum_warp.algos.npg_config import NPGConfig
from lyceum_warp.algos.planner import MPPI
from lyceum_warp.cli.arguments import ParamWords, Physics, Placement, TaskWord, parameters
from lyceum_warp.cli.display import make_console
from lyceum_warp.engines.memory import most_worlds
from lyceum_warp.env import Env
from lyceum_warp.graphs.compile_ahead import cached


@dataclasses.dataclass(frozen=True, kw_only=True)
class Warmup:
    """Compile a task's kernels ahead of time, so that later runs start immediately, and print the memory per world.

    Warp caches compiled kernels for each type of device. Kernels depend on the model and on physics options
    (--integrator, --solver, ...), so give the same options as in the later run. They do not depend on the number of
    worlds.

    $ lyceum-warp warmup hopper --device cuda:0 --nworld 4096 --npg
    $ lyceum-warp warmup reach --device cuda:0 --plan
    $ lyceum-warp warmup humanoid --device cuda:0 --integrator euler --solver ls_iterations=10
    """

    task: TaskWord
    nworld: int = 64
    """Number of worlds."""
    plan: bool = False
    """Whether to also compile MPPI's kernels."""
    npg: bool = False
    """Whether to also compile NPG's kernels."""
    param: ParamWords = ()
    env: tyro.conf.OmitArgPrefixes[Placement] = dataclasses.field(default_factory=Placement)
    physics: tyro.conf.OmitArgPrefixes[Physics] = dataclasses.field(default_factory=Physics)

    def run(self) -> int:
        """Run the command, and return the exit code."""
        more = self.physics.options().given() | parameters(self.param, self)
        start, before = time.perf_counter(), cached()
        env = Env(self.task, nworld=self.nworld, **vars(self.env), **more)
        for _ in range(3):  # run directly, capture, replay
            env.step()
        if self.npg:
            next(NPG(env, config=NPGConfig(samples=2 * env.nworld, mean_every=0)))
            env.replicate_few(1).step()  # as evaluations of the mean policy do
        if self.plan:
            # for a planner, auto depends on the number of samples, which is unknown here
            placement = vars(self.env) | {"engine": env.engine.name}
            plan = MPPI(self.task, **placement, **more)
            for _ in range(3):
                plan(plan.state_of())
        new = cached().keys() - before.keys()
        seconds, megabytes = time.perf_counter() - start, sum(cached()[path] for path in new) / 1e6
        console = make_console()
        built = f"compiled {len(new)} modules of kernels ({megabytes:.1f} MB)" if new else "all kernels were cached"
        console.print(f"{env.task.name} on {env.device.alias}: {built}, {seconds:.1f} s in all", soft_wrap=True)
        text = f"memory: about {env.bytes_per_world / 1e3:.1f} kB a world"
        most = most_worlds(env.bytes_per_world, env.device)
        if most is not None:
            text += f"; at most some {most:,d} worlds fit into the free memory"
        console.print(text, soft_wrap=True)
        return 0
