"""The command line: tasks, train, eval."""

import ast
import contextlib
import dataclasses
import datetime
import importlib.metadata
import inspect
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import rich.box
import torch
import tyro
from rich.console import Console
from rich.table import Table

from lyceum_warp.algos.npg import NPG, NPGConfig
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.rollout import Episodes, evaluate
from lyceum_warp.bound import BoundTask
from lyceum_warp.env import Env
from lyceum_warp.registry import find_task, task_name, task_names
from lyceum_warp.report import Display, curve_table, filmed, make_console, plotted
from lyceum_warp.runs import Run, load, versions
from lyceum_warp.viz.video import NoVideoError, check_video

_FINAL_EPISODES = 32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks that come with the package, with their sizes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy on a task with the natural policy gradient.

    The run's folder then holds config.json, versions.json, metrics.csv (a row an iteration), checkpoint.pt,
    curve.png and video.mp4. The checkpoint is renewed after every iteration: Ctrl-C loses only the one that
    is under way.

    $ lyceum-warp train hopper --iterations 100 --seed 1
    $ lyceum-warp train half_cheetah --param ctrl_cost_weight=0.05 --param reset_noise_scale=0 --hidden 32 32
    $ lyceum-warp train path/to/my_task.py --samples 4000 --out runs/mine
    $ lyceum-warp train --resume runs/mine --iterations 200
    """

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """A task's name (see lyceum-warp tasks), or a file with one: path/to/file.py, or path/to/file.py:Class."""
    iterations: int = 100
    """Iterations in total, those before --resume included."""
    seed: int = 0
    """Seed of the networks, the noise and the worlds' initial states."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The run's folder, new or empty; runs/TASK-DATE by default."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Continue the run in this folder, exactly and with all its settings. --iterations says up to where."""
    engine: str = "auto"
    """mujoco (C, on CPU cores), warp, or auto: warp on CUDA and mujoco on the CPU."""
    device: str = "cpu"
    """cpu, or a CUDA device such as cuda:0."""
    nworld: int = 64
    """Worlds that step at once, each samples / nworld steps in an iteration: whole episodes where those fit (the
    paper's way: 10 worlds for 10,000 samples and episodes of 1,000 steps), segments of them elsewhere."""
    threads: int = 1
    """Threads of torch on the CPU. Small networks gain little from more, and a number that is the same everywhere
    keeps runs the same to the bit. The mujoco engine uses all cores in any case."""
    param: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """A parameter of the task as NAME=VALUE, a vector as NAME=0.7,inf; may be given several times."""
    video: bool = True
    """Whether to film an episode of the trained policy at the end."""
    plot: bool = True
    """Whether to draw the learning curve at the end."""
    require_return: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Exit with code 1 unless the trained mean policy's return exceeds this."""
    npg: tyro.conf.OmitArgPrefixes[NPGConfig] = dataclasses.field(default_factory=NPGConfig)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval:
    """Run the mean policy of a run for whole episodes and print what came of them.

    $ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --video
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    episodes: int = 32
    """How many."""
    seed: int = 1
    """Seed of the initial states."""
    nworld: int = 32
    """Worlds that step at once, at most; no more than there are episodes."""
    engine: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """Another engine than the run's: mujoco, warp or auto."""
    device: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """Another device than the run's."""
    video: bool = False
    """Whether to film the first episode of one world, into eval.mp4 in the run's folder."""


_Command = Annotated[Tasks, tyro.conf.subcommand("tasks")] \
    | Annotated[Train, tyro.conf.subcommand("train")] \
    | Annotated[Eval, tyro.conf.subcommand("eval")]  # fmt: skip

_DESCRIPTION = """Batched MuJoCo worlds for robot learning.

$ lyceum-warp tasks
$ lyceum-warp train hopper --iterations 100
$ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --video
"""


class Interrupted(BaseException):
    """A signal asks the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def main(argv: Sequence[str] | None = None) -> int:
    """The program ``lyceum-warp``.

    Returns:
        0; 1 if --require-return was not met; 2 for bad input; 130 or 143 after Ctrl-C or SIGTERM.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"lyceum-warp {importlib.metadata.version('lyceum-warp')}")
        return 0
    try:
        with _signals():
            command = _parse(argv)
            if isinstance(command, Tasks):
                return _tasks()
            if isinstance(command, Eval):
                return _eval(command)
            if command.resume is not None:
                return _resume(_parse(argv, _saved(Run.open(command.resume), command.resume)), command.resume)
            return _train(command)
    except (ValueError, FileNotFoundError, FloatingPointError, ImportError, NoVideoError) as error:
        print(f"lyceum-warp: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except Interrupted as signalled:
        return 128 + signalled.number
    except BrokenPipeError:  # as in: lyceum-warp tasks | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _parse(argv: Sequence[str], default: Train | None = None) -> Any:
    options = {} if default is None else {"default": default}
    return tyro.cli(  # type: ignore[call-overload]
        _Command,
        prog="lyceum-warp",
        description=_DESCRIPTION,
        args=argv,
        config=(tyro.conf.OmitSubcommandPrefixes,),
        **options,
    )


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """Ctrl-C and SIGTERM raise Interrupted, once: a second one does not disturb the goodbye."""

    def interrupt(number: int, frame: Any) -> None:
        for other in previous:
            signal.signal(other, signal.SIG_IGN)
        raise Interrupted(number)

    previous: dict[int, Any] = {}
    try:
        for number in (int(signal.SIGINT), int(signal.SIGTERM)):
            # whoever started us in the background with SIGINT ignored means it
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, interrupt)
    except ValueError:  # not the main thread: signals are somebody else's
        pass
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


# lyceum-warp tasks


def _tasks() -> int:
    table = Table(box=rich.box.SIMPLE)
    for heading, side in [("task", "left"), ("obs", "right"), ("action", "right"), ("substeps", "right"),
                          ("timestep", "right"), ("horizon", "right"), ("", "left")]:  # fmt: skip
        table.add_column(heading, justify=side, no_wrap=bool(heading))  # type: ignore[arg-type]
    for name in task_names():
        task = BoundTask(find_task(name))
        about = (inspect.getdoc(sys.modules[find_task(name).__module__]) or "").partition("\n")[0]
        about = (about.partition(": ")[2] or about).rstrip(".")
        sizes = (sum(task.obs_layout.values()), task.model.nu, task.frame_skip)
        horizon = str(task.task.horizon or "none")
        table.add_row(name, *map(str, sizes), f"{task.timestep:g} s", horizon, about)
    console = make_console()
    console.print(table)
    console.print("[dim]timestep: seconds in a step, all its substeps together. A task of your own: path/to/file.py[/]")
    return 0


# lyceum-warp train


def _train(options: Train) -> int:
    if options.task is None:
        raise ValueError(f"train needs a task: one of {', '.join(task_names())}, or path/to/file.py")
    _check_iterations(options.iterations)
    task = find_task(options.task)
    out = options.out or Path("runs", f"{task_name(task)}-{datetime.datetime.now():%Y%m%d-%H%M%S}")
    Run.check_free(out)
    # all that can be wrong with the options comes to light before the folder is made
    config = {
        "algorithm": "npg",
        "task": _portable(options.task),
        "params": dict(_parameter(text) for text in options.param),
        "engine": options.engine,
        "device": options.device,
        "nworld": options.nworld,
        "threads": options.threads,
        "seed": options.seed,
        "iterations": options.iterations,
        "npg": dataclasses.asdict(options.npg),
    }
    npg = _algorithm(config)
    run = Run.create(out, config, device=options.device)
    run.save(0, npg.policy, npg.state_dict(), npg.value)
    return _learn(run, npg, options)


def _saved(run: Run, folder: Path) -> Train:
    """The options that a run was started with."""
    config = run.config
    try:
        npg = _hyperparameters(config)
        return Train(
            task=config["task"], iterations=config["iterations"], seed=config["seed"], resume=folder,
            engine=config["engine"], device=config["device"], nworld=config["nworld"],
            threads=config["threads"],
            param=tuple(f"{name}={_spelled(value)}" for name, value in config["params"].items()), npg=npg,
        )  # fmt: skip
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder / 'config.json'} is not the configuration of an NPG run ({error})") from error


def _resume(options: Train, folder: Path) -> int:
    run = Run.open(folder)
    given, saved = (_settings(o) for o in (options, _saved(run, folder)))
    for name, value in given.items():
        if value != saved[name]:
            raise ValueError(
                f"the run in {folder} has {name} {_spelled(saved[name])}, not {_spelled(value)}, and a run keeps its "
                f"settings: leave the option out, or start a new run without --resume"
            )
    if options.out not in (None, folder):
        raise ValueError(f"a resumed run stays in its folder {folder}: leave out --out")
    checkpoint = run.read()
    done = checkpoint["iteration"]
    if options.iterations <= done:
        raise ValueError(
            f"the run in {folder} has {done} iterations already: ask for more, as in --iterations {2 * done}"
        )
    npg = _algorithm(run.config)
    try:
        npg.load_state_dict(run.read(npg.env.obs.device)["state"])
    except (KeyError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{run.checkpoint} does not fit the configuration beside it: {reason}") from error
    _warn_of_versions(run)
    run.cut(done)
    run.amend(iterations=options.iterations)
    return _learn(run, npg, options)


def _settings(options: Train) -> dict[str, Any]:
    """What a resumed run has to keep."""
    free = ("iterations", "out", "resume", "video", "plot", "require_return", "npg", "param")
    settings = {f.name: getattr(options, f.name) for f in dataclasses.fields(options) if f.name not in free}
    settings["task"] = _portable(options.task or "")
    settings["param"] = dict(_parameter(text) for text in options.param)
    return settings | dataclasses.asdict(options.npg)


def _hyperparameters(config: dict[str, Any]) -> NPGConfig:
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in config["npg"].items()}
    return NPGConfig(**values)


def _algorithm(config: dict[str, Any]) -> NPG:
    if config["threads"] < 1:
        raise ValueError(f"threads has to be at least 1, not {config['threads']}")
    torch.set_num_threads(config["threads"])
    env = Env(
        config["task"], nworld=config["nworld"], engine=config["engine"], device=config["device"],
        seed=config["seed"], **config["params"],
    )  # fmt: skip
    npg = _hyperparameters(config)
    return NPG(env, config=npg, seed=config["seed"])


def _learn(run: Run, npg: NPG, options: Train) -> int:
    console = make_console()
    env = npg.env
    engine = {"auto": "mujoco" if env.device.is_cpu else "warp"}.get(options.engine, options.engine)
    console.print(
        f"[bold]{env.task.name}[/]: {env.obs_space.size} observations, {env.action_space.size} actions; "
        f"{env.nworld} worlds, {engine} engine on {options.device}, "
        f"{'segments' if npg.segments else 'episodes'} of {npg.rollout.steps} steps; run in {run.folder}",
        soft_wrap=True,
    )  # fmt: skip
    try:
        with Display(console, npg.iteration, options.iterations) as display:
            while npg.iteration < options.iterations:
                record = next(npg)
                run.write(dataclasses.asdict(record))
                run.save(npg.iteration, npg.policy, npg.state_dict(), npg.value)
                display(record)
    except Interrupted as signalled:
        # iterations count when their checkpoint is complete; what is under way is lost
        done = run.read()["iteration"]
        run.cut(done)
        told = f"interrupted by {signal.Signals(signalled.number).name} after {done} of {options.iterations} iterations"
        mend = f"lyceum-warp train --resume {run.folder} --iterations {options.iterations}"
        console.print(f"{told}; continue with\n  {mend}", soft_wrap=True, markup=False)
        raise
    return _report(run, npg, options, console)


def _report(run: Run, npg: NPG, options: Train, console: Console) -> int:
    """What came of it: the table, the curve, the video, and whether it is enough."""
    rows = run.rows()
    console.print(curve_table(rows))
    episodes = _evaluate(npg.env, npg.policy, _FINAL_EPISODES, seed=options.seed + 1)
    console.print(f"mean policy, {len(episodes.returns)} new episodes: {_returns(episodes)}", soft_wrap=True)
    paths = [("checkpoint", str(run.checkpoint)), ("metrics", str(run.metrics))]
    if options.plot:
        paths.append(("curve", plotted(run)))
    if options.video:
        paths.append(("video", filmed(npg.env, npg.policy, run.folder / "video.mp4", options.seed + 1)))
    for name, path in paths:
        console.print(f"{name + ':':<12}{path}", soft_wrap=True, markup=False)
    final = episodes.returns.mean().item()
    if options.require_return is not None and not final > options.require_return:
        print(
            f"lyceum-warp: the mean policy's return is {final:.1f}; --require-return asks for more than "
            f"{options.require_return:g}",
            file=sys.stderr,
        )
        return 1
    return 0


def _evaluate(env: Env, policy: GaussianPolicy, episodes: int, *, seed: int, nworld: int = _FINAL_EPISODES) -> Episodes:
    return evaluate(env.replicate(nworld=min(nworld, episodes)), policy, episodes, seed=seed)


def _returns(episodes: Episodes) -> str:
    r = episodes.returns
    return f"return {r.mean():.1f} ± {r.std(correction=0):.1f} ({r.min():.1f} to {r.max():.1f})"


def _warn_of_versions(run: Run) -> None:
    changed = run.changed(versions(run.config["device"]))
    if changed:
        told = ", ".join(f"{name} {old} then, {new} now" for name, (old, new) in changed.items())
        print(f"lyceum-warp: the run goes on with other versions, so not to the bit: {told}", file=sys.stderr)


# lyceum-warp eval


def _eval(options: Eval) -> int:
    if options.episodes < 1 or options.nworld < 1:
        raise ValueError(f"eval needs at least 1 episode and 1 world, not {options.episodes} and {options.nworld}")
    if options.video:
        check_video()
    run = Run.open(options.run)
    config = run.config
    nworld = min(options.nworld, options.episodes)
    device = options.device or config["device"]
    env = Env(
        config["task"], nworld=nworld, engine=options.engine or config["engine"], device=device, **config["params"]
    )
    policy = load(run, device=env.obs.device)
    sizes, wanted = (policy.nobs, policy.nact), (env.obs_space.size, env.action_space.size)
    if sizes != wanted:
        raise ValueError(
            f"the policy in {options.run} takes {sizes[0]} observations and gives {sizes[1]} actions, but the task "
            f"{env.task.name!r} now has {wanted[0]} and {wanted[1]}: evaluate it with the task as it was"
        )
    episodes = evaluate(env, policy, options.episodes, seed=options.seed)
    episodes = Episodes(*(getattr(episodes, f.name)[: options.episodes] for f in dataclasses.fields(episodes)))
    table = Table(box=rich.box.SIMPLE)
    for heading in ("", "mean", "std", "min", "max"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, values in (("return", episodes.returns), ("evaluation at the end", episodes.evals),
                         ("last reward", episodes.rewards), ("length", episodes.lengths)):  # fmt: skip
        numbers = (values.mean(), values.std(correction=0), values.min(), values.max())
        table.add_row(name, *(f"{number.item():.6g}" for number in numbers))
    console = make_console()
    console.print(f"{env.task.name}: {options.episodes} episodes of the mean policy in {options.run}", soft_wrap=True)
    console.print(table)
    if env.task.functions["success"] is not None:
        console.print(f"success: {episodes.success.mean().item():.0%}")
    if options.video:
        video = filmed(env, policy, run.folder / "eval.mp4", options.seed)
        console.print(f"video: {video}", soft_wrap=True, markup=False)
    return 0


# values on the command line and in config.json


def _check_iterations(iterations: int) -> None:
    if iterations < 1:
        raise ValueError(f"iterations has to be at least 1, not {iterations}")


def _portable(task: str) -> str:
    """A task's file with its whole path, so that the run can be used from another folder."""
    path, colon, attribute = task.partition(":")
    return f"{Path(path).resolve()}{colon}{attribute}" if path.endswith(".py") else task


def _parameter(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"a parameter is given as NAME=VALUE, not {text!r}")
    parts = [_value(part, text) for part in value.strip().strip("[]()").split(",") if part.strip()]
    if not parts:
        raise ValueError(f"a parameter is given as NAME=VALUE, not {text!r}")
    return name.strip(), parts[0] if len(parts) == 1 else parts


def _value(part: str, text: str) -> bool | int | float:
    part = part.strip()
    if part.lower() in ("true", "false"):
        return part.lower() == "true"
    try:
        value = ast.literal_eval(part)
        return value if isinstance(value, (bool, int)) else float(part)
    except (ValueError, SyntaxError, TypeError):
        pass
    try:
        return float(part)  # inf
    except ValueError:
        raise ValueError(f"the value in {text!r} is no number, true or false") from None


def _spelled(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


if __name__ == "__main__":
    sys.exit(main())
