"""Control a task with a planner: lyceum-warp plan."""

import dataclasses
import datetime
import functools
import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.markup import escape

from lyceum_warp import controllers, training, viz
from lyceum_warp.algos import MPPI, MPPIConfig, PlanUpdate, task_config
from lyceum_warp.binding import class_in_file, file_name, find_task, made, spelled_task, task_name
from lyceum_warp.cli import arguments
from lyceum_warp.cli.display import console, counted, episode_result, say, say_entries, tried
from lyceum_warp.core import EnvOptions, Task
from lyceum_warp.env import Env
from lyceum_warp.support.interrupts import Interrupted
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.validate import positive_number, whole_number


class Settings(arguments.OptionFlags, options=[MPPIConfig], omit=["fill"]):
    """Settings of the planner. The defaults come from the task. The setting ``fill`` has no flag."""

    update: Annotated[str | None, tyro.conf.arg(metavar="mppi|cem|predictive_sampling|FILE")] = None
    """How to compute the new plan: mppi (the default), cem (the cross-entropy method), predictive_sampling, or
    path/to/file.py:Class, a subclass of lw.PlanUpdate whose constructor needs no arguments."""

    noise: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT ...")] = None
    """Standard deviation of the noise around the plan, in units of the action: one number, or one for each action.
    The Python API also accepts a covariance matrix."""
    min_noise: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT ...")] = None

    def on_top_of(self, config: MPPIConfig) -> MPPIConfig:
        """Override a configuration's settings with the given flags."""
        settings = arguments.given(self)
        if ".py:" in settings.get("update", ""):
            settings["update"] = made(class_in_file(settings["update"], PlanUpdate))
        for name in ("noise", "min_noise"):
            if name in settings and len(settings[name]) == 1:
                settings[name] = settings[name][0]
        return config.changed(settings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Control a task with a planner that replans at every step, and report rewards, success and planning times.

    The default planner is MPPI. --update selects the cross-entropy method (cem) or predictive sampling instead. The
    default settings come from the task. Physics options (--physics, --integrator, ...) apply only to the planner's
    worlds.

    With --real-time, the world does not wait for plans. The command then measures planning times for a few seconds, and
    chooses the largest number of samples that meets the deadline. If no number meets the deadline, the command tries a
    shorter horizon, and then other physics that the task defines. Values that you give are never changed.

    The command writes config.json and report.json into a folder. It also writes video.mp4 of the first episode, and a
    numpy file such as episode-000.npz for each episode. After Ctrl-C, the interrupted episode is saved, too, but is not
    part of the report.

    $ lyceum-warp plan reach
    $ lyceum-warp plan reach --real-time --episodes 10
    $ lyceum-warp plan half_cheetah --steps 200 --samples 128 --temperature 1
    $ lyceum-warp plan reach --update predictive_sampling --knots 4 --replan-every 2
    $ lyceum-warp plan hopper --horizon 16 --value runs/hopper --discount 0.995
    $ lyceum-warp plan humanoid --physics exact --steps 100
    $ lyceum-warp plan adroit_pen --device cuda:0 --samples 1024
    """

    USUAL = ("episodes", "steps", "seed", "real_time", "out", "param", "device", "horizon", "samples", "physics")

    task: arguments.TaskWord
    episodes: int = 1
    """Number of episodes."""
    minutes: float | None = None
    """The time limit in minutes, after which no episode begins."""
    steps: int | None = None
    """Number of steps in an episode; by default the task's horizon."""
    replan_every: int = 1
    """The number of steps from one plan to the next. Steps between two plans apply further actions of the last plan."""
    seed: int = 0
    """Seed of the first episode's initial state and noise. The seed increases by one for each further episode."""
    real_time: bool = False
    """Step the world in real time while the planner plans, instead of waiting for each plan."""
    predict: bool = False
    """With --real-time, plan from a prediction of the state at the end of the current step."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """A new or empty folder; by default runs/plan-TASK-DATE."""
    value: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """The folder of an NPG or PPO run of the same task. The planner evaluates the run's value function at each
    sample's final state, and adds this value to the sample's return.
    """
    param: arguments.ParamWords = ()
    planner_param: arguments.Repeated = ()
    """A parameter of the task that only the planner's worlds use. The flag may be repeated."""
    video: bool = True
    """Whether to make a video of the first episode."""
    camera: arguments.CameraWords = ()
    planner: arguments.Placement = arguments.Placement()
    """The engine and the device of the planner's worlds. The controlled world runs in one thread of the mujoco
    engine, and has the cameras."""
    mppi: Settings = Settings()
    planner_physics: arguments.Physics = arguments.Physics()

    def run(self) -> None:
        # check all options before the folder is created
        whole_number("episodes", self.episodes, low=1)
        whole_number("seed", self.seed, low=0)
        every = whole_number("replan_every", self.replan_every, low=1)
        if self.minutes is not None:
            positive_number("minutes", self.minutes, "minutes")
        if self.predict and not self.real_time:
            raise ValueError("without --real-time, the world waits for each plan, so --predict has no effect: omit it")
        if every > 1 and self.real_time:
            raise ValueError(
                f"--replan-every {every} has no effect with --real-time, where plans follow one another without a "
                "break: omit one of them"
            )
        camera = arguments.video_camera(self.camera)
        if camera is not None and not self.video:
            raise ValueError("--camera has no effect with --no-video: omit one of them")
        task = task_name(find_task(self.task))
        if self.value is not None:
            run = training.Run.open(self.value)
            if run.task_name != task or run.config.get("algorithm") == "sac":
                raise ValueError(
                    f"--value {self.value} is a run of {run.config['algorithm']} and the task {run.task_name!r}: use a "
                    f"run of npg or ppo and the task {task!r}"
                )
        out = self.out or Path("runs", f"plan-{file_name(task)}-{datetime.datetime.now():%Y%m%d-%H%M%S}")
        training.Run.check_free(out)
        torch.set_num_threads(1)
        params = arguments.parameters(self.param)
        planner_params = arguments.parameters(self.planner_param)
        plant, make_planner = _worlds(self, params, planner_params)
        viz.find_camera(plant.model, camera)
        choice = _choice(self, plant, make_planner) if self.real_time else None
        if choice is not None:
            every = round(choice.deadline / plant.timestep) * choice.replan_every
            say(str(choice))
        planner = make_planner(None if choice is None else choice.setting)
        controllers.CheckedController(planner, plant).check_horizon(planner.horizon, every)
        config = {
            "algorithm": planner.settings["update"], "task": spelled_task(plant.task.definition), "params": params,
            "planner": planner.settings, "planner_params": planner_params,
            "value": self.value and str(self.value.resolve()), **vars(self.planner),
            "engine": planner.env.engine.name, "device": self.planner.device or "cpu",
            "episodes": self.episodes, "steps": self.steps,
            "replan_every": every, "seed": self.seed, "real_time": self.real_time, "predict": self.predict,
        }  # fmt: skip
        run = training.Run.create(out, config)
        _run(run, plant, planner, dataclasses.replace(self, replan_every=every))


def _worlds(
    options: Plan, params: dict[str, Any], planner_params: dict[str, Any]
) -> tuple[Env, Callable[[controllers.RealTimeSetting | None], MPPI]]:
    """Make the controlled world, and a function that makes a planner.

    The function takes None, or a ``RealTimeSetting`` that overrides the flags.
    """
    planner_options = arguments.given(options.planner) | arguments.given(options.planner_physics)
    env_options: dict[str, Any] = {} if options.steps is None else {"horizon": options.steps}
    env_options |= {"objects": planner_options.get("objects"), "cameras": planner_options.pop("cameras", None)}
    plant = Env(options.task, EnvOptions(autoreset=False, nthread=1, **env_options), params)
    if plant.horizon == 0:
        raise ValueError(f"episodes of {plant.task.name!r} have no time limit: give --steps")
    task = plant.task.definition
    value = None if options.value is None else training.load_value(options.value)
    config = options.mppi.on_top_of(task_config(task, value))

    def make(setting: controllers.RealTimeSetting | None) -> MPPI:
        changes: dict[str, Any] = {}
        physics: dict[str, Any] = {}
        if setting is not None:
            # scale the knots with the horizon, so that the time between knots stays the same
            knots = config.knots and max(1, config.knots * setting.horizon // config.horizon)
            changes = {"samples": setting.samples, "horizon": setting.horizon, "knots": knots}
            if setting.physics not in (None, _suggested_physics(task)):
                physics = {"physics": setting.physics}
        final = config.changed(changes)
        return MPPI(task, final, value=value, params=params | planner_params, **planner_options | physics)

    return plant, make


_SAMPLES = (16, 32, 64, 128, 256, 512, 1024)


def _choice(
    options: Plan, plant: Env, make: Callable[[controllers.RealTimeSetting], MPPI]
) -> controllers.RealTimeChoice | None:
    """Choose the settings for which no flag was given, by measuring planning times.

    A plan must be ready within one step of the controlled world. If no setting is fast enough, a plan may take as long
    as one step of the planner's worlds.
    """
    task, flags = plant.task.definition, arguments.given(options.mppi)
    config = options.mppi.on_top_of(task_config(task))
    samples = [config.samples]
    if not {"samples", "elites"} & flags.keys():
        samples = sorted({*_SAMPLES, *samples})
    horizons = [config.horizon]
    if config.horizon > 1 and not {"horizon", "knots"} & flags.keys():
        horizons.append(config.horizon // 2)
    physics = [options.planner_physics.physics]
    if not arguments.given(options.planner_physics):
        physics = list(dict.fromkeys((_suggested_physics(task), *task.physics)))
    if len(samples) == len(horizons) == len(physics) == 1:
        return None

    @functools.cache
    def measure(setting: controllers.RealTimeSetting) -> float:
        return controllers.planning_time(plant, make(setting))

    choice = controllers.choose_setting(samples, horizons, physics, measure, deadline=plant.timestep)
    if choice.replan_every > 1 and (step := make(choice.setting).timestep) > plant.timestep:
        choice = controllers.choose_setting(samples, horizons, physics, measure, deadline=step)
    return choice


def _suggested_physics(task: type[Task]) -> str | None:
    return EnvOptions().changed(task.planning.options).physics.base


def _run(run: training.Run, plant: Env, planner: MPPI, options: Plan) -> None:
    simulated, update = planner.env, planner.settings["update"]
    name = {"mppi": "MPPI", "cem": "CEM", "predictive_sampling": "predictive sampling"}.get(update, update)
    physics = ", ".join(f"{option} {value}" for option, value in simulated.options.physics.given().items())
    console.print(
        f"[bold]{plant.task.name}[/]: {name}, {planner.samples} samples of {planner.horizon} steps "
        f"({planner.horizon * planner.timestep:.3g} s), {simulated.engine.name} engine on {simulated.device.alias}"
        f"{f' ({physics})' if physics else ''}; "
        f"{'real time' if options.real_time else 'the world waits'}; files in {escape(str(run.folder))}",
        soft_wrap=True,
    )  # fmt: skip
    complete: list[controllers.Trajectory] = []
    aborted: list[controllers.Trajectory] = []
    method: Any = functools.partial(controllers.control, replan_every=options.replan_every)
    if options.real_time:
        method = functools.partial(controllers.control_async, predict=options.predict)
    end = math.inf if options.minutes is None else time.monotonic() + 60 * options.minutes
    try:
        for episode in range(options.episodes):
            if complete and time.monotonic() >= end:
                limit = f"the limit is {options.minutes:g} minutes"
                say(f"stopped after {len(complete)} of {options.episodes} episodes: {limit}")
                break
            title = f"episode {episode + 1}/{options.episodes}"
            with LongWork(title, "steps", console) as work:
                trajectory = method(
                    plant, planner, seed=options.seed + episode, on_abort=aborted.append,
                    on_step=lambda now, work=work: work(now.step, plant.horizon),
                )  # fmt: skip
            complete.append(trajectory)
            say(f"{title}: {episode_result(trajectory)}")
            console.file.flush()
            report = _save(run, complete, options)
    except BaseException as error:  # ignore further signals until the files are written
        if complete:
            _save(run, complete, options)
        for part in aborted:
            part.save(_file(run, len(complete)))
        if isinstance(error, Interrupted):
            episodes = counted(len(complete), "episode")
            steps = counted(sum(part.steps for part in aborted), "step")
            name = signal.Signals(error.number).name
            say(f"interrupted by {name} after {episodes} and {steps}; files in {run.folder}")
        raise
    for label, text in report.rows():
        if label != "success" or plant.task.functions["success"] is not None:
            say(f"  {label:<30}{text}")
    paths = {"episodes": str(run.folder / "episode-*.npz"), "report": str(run.folder / "report.json")}
    if options.video:
        camera = arguments.video_camera(options.camera)
        paths["video"] = tried(viz.write_video, plant, complete[0].states, run.folder / "video.mp4", camera=camera)
    paths["next"] = f"lyceum-warp view {run.folder}, or lyceum-warp report {run.folder}"
    say_entries(**paths)


def _file(run: training.Run, episode: int) -> Path:
    return run.folder / f"episode-{episode:03d}.npz"


def _save(run: training.Run, episodes: list[controllers.Trajectory], options: Plan) -> controllers.ControlReport:
    episodes[-1].save(_file(run, len(episodes) - 1))
    # the deadline of a plan is the time from one plan to the next
    report = controllers.control_report(episodes, rate=1 / (options.replan_every * episodes[0].period))
    report.write(run.folder / "report.json")
    return report
