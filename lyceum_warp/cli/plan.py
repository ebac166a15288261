"""lyceum-warp plan."""

import dataclasses
import datetime
import signal
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lyceum_warp.algos.mppi import MPPI
from lyceum_warp.binding.registry import find_task, task_name
from lyceum_warp.cli.arguments import Interrupted, Physics, Words, parameter, portable
from lyceum_warp.cli.display import PlanDisplay, make_console, plotted_control, report_table, states_video
from lyceum_warp.control.control_report import control_report
from lyceum_warp.control.loop import control
from lyceum_warp.control.real_time import control_async
from lyceum_warp.control.trajectory import Trajectory
from lyceum_warp.env import Env
from lyceum_warp.runs import Run, load_value
from lyceum_warp.validate import whole_number


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Control a task with MPPI: plan anew at every step, and report how well and how fast.

    The folder then holds config.json, versions.json, a file for each episode (episode-000.npz: states, actions,
    rewards, evaluations, times; numpy reads it), report.json, plan.png and video.mp4 of the first episode. What is
    not given of the planner's settings comes from the task. After Ctrl-C, the episode under way has a file, too, but
    no part in the report.

    --integrator, --solver, --deterministic and --unroll are the planner's: what is controlled keeps its own physics.

    $ lyceum-warp plan reach
    $ lyceum-warp plan reach --real-time --episodes 10
    $ lyceum-warp plan half_cheetah --steps 200 --samples 128 --temperature 1
    $ lyceum-warp plan hopper --steps 300 --horizon 16 --value runs/hopper-20260101-120000 --discount 0.995
    $ lyceum-warp plan adroit_pen --device cuda:0 --samples 1024 --solver noslip_iterations=0
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """A task's name (see lyceum-warp tasks), or a file with one: path/to/file.py, or path/to/file.py:Class."""
    episodes: int = 1
    """How many."""
    steps: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Steps of an episode; by default the task's horizon."""
    seed: int = 0
    """Seed of the first episode's initial state and noise; the next episode has the next number."""
    real_time: bool = False
    """Let the world run at its own rate while the planner plans, instead of waiting for each plan."""
    rate: Annotated[float | None, tyro.conf.arg(metavar="HZ")] = None
    """Plans a second that are asked for, which makes the deadline; by default one a step."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The folder, new or empty; runs/plan-TASK-DATE by default."""

    horizon: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Steps of a plan."""
    samples: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Roll-outs for each improvement of the plan."""
    temperature: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """In units of reward: low ones follow the best sample, high ones average all."""
    noise: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT ...")] = None
    """Standard deviation of the noise, one number or one for each action (a covariance only from Python)."""
    smoothing: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="B0 B1 B2")] = None
    """Weights of the noise, of the last step's and of the one before it; 1 0 0 is white noise."""
    discount: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Of rewards and of the terminal value, a step."""
    iterations: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Improvements of the plan at every step."""
    fill: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="WORD|FLOAT ...")] = None
    """What fills the end of a plan that moves forward: zero, repeat, or an action, one number or one for each."""
    termination: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """Whether a sample that ends its episode stops earning (stop) or not (ignore)."""
    value: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Run of NPG whose value function tells what the end of a plan is worth."""

    engine: str = "auto"
    """Engine of the planner: mujoco (C, on CPU cores), warp, or auto. The world itself runs on mujoco."""
    device: str = "cpu"
    """Device of the planner: cpu, or a CUDA device such as cuda:0."""
    nthread: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Threads of the planner's mujoco engine; all cores by default."""
    param: Annotated[Words, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """A parameter of the task as NAME=VALUE, a vector as NAME=0.7,inf; may be given several times."""
    planner_param: Annotated[Words, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Another value of a parameter, for the planner alone."""
    planner_model: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Another model for the planner than for the world."""
    video: bool = True
    """Whether to film the first episode."""
    plot: bool = True
    """Whether to draw rewards, planning times and ages."""
    planner_physics: tyro.conf.OmitArgPrefixes[Physics] = dataclasses.field(default_factory=Physics)
    """How the planner simulates; the world itself stays as it is."""


_SETTINGS = (
    "horizon", "samples", "temperature", "noise", "smoothing", "discount", "iterations", "fill", "termination",
)  # fmt: skip


def plan(options: Plan) -> int:
    """The command."""
    whole_number("episodes", options.episodes, low=1)
    whole_number("seed", options.seed, low=0)
    whole_number("seed of the last episode", options.seed + options.episodes - 1, low=0)
    if options.rate is not None and not 0 < options.rate < float("inf"):
        raise ValueError(f"rate has to be a positive number of plans a second, not {options.rate}")
    out = options.out or Path(
        "runs", f"plan-{task_name(find_task(options.task))}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    )
    Run.check_free(out, resumable=False)
    # all that can be wrong with the options comes to light before the folder is made
    torch.set_num_threads(1)
    plant, planner = _worlds(options)
    config = {
        "algorithm": "mppi", "task": portable(options.task), "params": dict(map(parameter, options.param)),
        "planner": planner.settings, "planner_params": dict(map(parameter, options.planner_param)),
        "planner_model": options.planner_model and str(_model(options.planner_model)),
        "value": options.value and str(options.value.resolve()), "engine": planner.env.engine.name,
        "device": options.device, "nthread": options.nthread, "episodes": options.episodes, "steps": options.steps,
        "seed": options.seed, "real_time": options.real_time, "rate": options.rate,
    }  # fmt: skip
    return _run(Run.create(out, config, device=options.device), plant, planner, options)


def _worlds(options: Plan) -> tuple[Env, MPPI]:
    params = dict(map(parameter, options.param))
    steps: dict[str, Any] = {} if options.steps is None else {"horizon": whole_number("steps", options.steps, low=1)}
    plant = Env(options.task, autoreset=False, nthread=1, **steps, **params)
    if plant.horizon == 0:
        raise ValueError(f"episodes of {plant.task.name!r} never end without a horizon: give --steps")
    settings = {name: getattr(options, name) for name in _SETTINGS}
    if options.noise is not None and len(options.noise) == 1:
        settings["noise"] = options.noise[0]
    if options.fill is not None:
        settings["fill"] = _fill(options.fill, plant.action_space.size)
    more: dict[str, Any] = {}
    if options.nthread is not None:
        more["nthread"] = options.nthread
    if options.planner_model is not None:
        more["model"] = _model(options.planner_model)
    if options.value is not None:
        more["value"] = load_value(options.value)
    planner = MPPI(
        options.task, **settings, engine=options.engine, device=options.device, **more,
        **(options.planner_physics.given() | params | dict(map(parameter, options.planner_param))),
    )  # fmt: skip
    return plant, planner


def _fill(words: tuple[str, ...], nu: int) -> str | list[float]:
    """What the option says: a word, or numbers, of which one stands for all."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words)  # the planner knows the words, and says so
    return numbers * nu if len(numbers) == 1 else numbers


def _model(path: Path) -> Path:
    """A model's file: here a path is meant, where a task may also name one that a package ships."""
    path = path.expanduser().resolve()
    if not path.is_file():
        raise FileNotFoundError(f"--planner-model: there is no file {path}")
    return path


def _run(run: Run, plant: Env, planner: MPPI, options: Plan) -> int:
    console, simulated = make_console(), planner.env
    console.print(
        f"[bold]{plant.task.name}[/]: {planner.samples} samples of {planner.horizon} steps "
        f"({planner.horizon * planner.timestep:.3g} s), {simulated.engine.name} engine on {simulated.device.alias}; "
        f"{'real time' if options.real_time else 'the world waits'}; files in {run.folder}",
        soft_wrap=True,
    )  # fmt: skip
    trajectories: list[Trajectory] = []
    part: list[Trajectory] = []
    method: Any = control_async if options.real_time else control
    shown: dict[str, Any] = dict(steps=plant.horizon, timestep=plant.timestep, real_time=options.real_time)
    try:
        for episode in range(options.episodes):
            with PlanDisplay(console, episode, options.episodes, **shown) as display:
                seed = options.seed + episode
                trajectory = method(plant, planner, seed=seed, on_step=display, on_abort=part.append)
            trajectories.append(trajectory)
            display.done(trajectory)
            _save(run, trajectories, options)
    except BaseException as error:  # a second signal does not disturb what follows
        if trajectories:
            _save(run, trajectories, options)
        path = part[0].save(_file(run, len(trajectories))) if part else None
        if isinstance(error, Interrupted):
            told = f"interrupted by {signal.Signals(error.number).name} "
            console.print(told + _left(run, len(trajectories), part, path), soft_wrap=True, markup=False)
        raise
    return _tell(run, plant, trajectories, options)


def _left(run: Run, whole: int, part: list[Trajectory], path: Path | None) -> str:
    """What an interrupted run leaves behind."""
    steps = f"after {part[0].steps} step{'s' * (part[0].steps != 1)}" if part else "before its first step"
    if not whole:
        where = f"it is in {path}" if path else f"{run.folder} holds no episode"
        return f"in the first episode, {steps}; {where}"
    told = f"after {whole} episode{'s' * (whole != 1)}; in {run.folder}"
    return f"{told}; the episode under way is in {path.name}, {steps}" if path else told


def _file(run: Run, episode: int) -> Path:
    return run.folder / f"episode-{episode:03d}.npz"


def _save(run: Run, trajectories: list[Trajectory], options: Plan) -> None:
    """Write the last episode, and the report of all."""
    trajectories[-1].save(_file(run, len(trajectories) - 1))
    control_report(trajectories, rate=options.rate).write(run.folder / "report.json")


def _tell(run: Run, plant: Env, trajectories: list[Trajectory], options: Plan) -> int:
    console = make_console()
    console.print(report_table(control_report(trajectories, rate=options.rate)))
    paths = [("episodes", str(run.folder / "episode-*.npz")), ("report", str(run.folder / "report.json"))]
    if options.plot:
        paths.append(("plot", plotted_control(trajectories, run.folder / "plan.png")))
    if options.video:
        paths.append(("video", states_video(plant, trajectories[0].states, run.folder / "video.mp4")))
    for name, path in paths:
        console.print(f"{name + ':':<12}{path}", soft_wrap=True, markup=False)
    return 0
