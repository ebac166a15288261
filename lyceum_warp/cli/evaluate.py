"""lyceum-warp eval."""

import dataclasses
from pathlib import Path
from typing import Annotated

import rich.box
import tyro
from rich.table import Table

from lyceum_warp.algos.evaluation import evaluate, evaluation_seed
from lyceum_warp.cli.arguments import NO_FLAGS, given, optional_flags, run_options
from lyceum_warp.cli.display import make_console, policy_video
from lyceum_warp.engines.placement import options_for_few_worlds
from lyceum_warp.env import Env
from lyceum_warp.options import EnvOptions
from lyceum_warp.runs import Run, load
from lyceum_warp.viz.video import check_video


@optional_flags(EnvOptions, omit=NO_FLAGS, default="(default: the run's)")
class OtherEnv:
    """Other options than the run's."""

    engine: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """mujoco (the C engine, on CPU cores), warp, or auto."""
    device: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """cpu, or a CUDA device such as cuda:0. Without this flag a run whose engine is auto is evaluated on the CPU: a few
    worlds step fastest there."""
    nthread: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Threads of the C engine."""
    horizon: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Steps after which an episode is truncated, 0 for never."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval:
    """Run the mean policy of a run for whole episodes, in the run's own physics, and print statistics of them.

    $ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --video
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    episodes: int = 32
    """Number of episodes."""
    seed: int = 1
    """Seed of the initial states."""
    nworld: int = 32
    """Largest number of worlds; never more than episodes."""
    video: bool = False
    """Whether to write a video of one episode, eval.mp4 in the run's folder."""
    env: tyro.conf.OmitArgPrefixes[OtherEnv] = dataclasses.field(default_factory=OtherEnv)


def evaluate_run(options: Eval) -> int:
    """Run the command; returns the exit code."""
    if options.episodes < 1 or options.nworld < 1:
        raise ValueError(f"eval needs at least 1 episode and 1 world, not {options.episodes} and {options.nworld}")
    if options.video:
        check_video()
    run = Run.open(options.run)
    config = run.config
    nworld = min(options.nworld, options.episodes)
    known, params = run_options(config)
    known = known.changed({"nworld": nworld} | given(options.env))
    if options.env.device is None:
        known = known.changed(options_for_few_worlds(known.engine, known.device))
    env = Env(config["task"], known, **params)
    policy = load(run, device=env.obs.device)
    sizes, wanted = (policy.nobs, policy.nact), (env.obs_space.size, env.action_space.size)
    if sizes != wanted:
        raise ValueError(
            f"the policy in {options.run} takes {sizes[0]} observations and gives {sizes[1]} actions, but the task "
            f"{env.task.name!r} now has {wanted[0]} and {wanted[1]}: evaluate it with the task that it was trained on"
        )
    episodes = evaluate(env, policy, options.episodes, seed=options.seed).first(options.episodes)
    table = Table(box=rich.box.SIMPLE)
    for heading in ("", "mean", "std", "min", "max"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, values in (("return", episodes.returns), ("evaluation at the end", episodes.evals),
                         ("last reward", episodes.rewards), ("length", episodes.lengths),
                         *episodes.metrics.items()):  # fmt: skip
        numbers = (values.mean(), values.std(correction=0), values.min(), values.max())
        table.add_row(name, *(f"{number.item():.6g}" for number in numbers))
    console = make_console()
    console.print(f"{env.task.name}: {options.episodes} episodes of the mean policy in {options.run}", soft_wrap=True)
    console.print(table)
    if env.task.functions["success"] is not None:
        console.print(f"success: {episodes.success.mean().item():.0%}")
    if options.video:
        video = policy_video(env, policy, run.folder / "eval.mp4", evaluation_seed(options.seed))
        console.print(f"video: {video}", soft_wrap=True, markup=False)
    return 0
