"""Show a task, a policy, a planner or saved episodes: lyceum-warp view."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lyceum_warp.algos.mppi_arguments import task_config
from lyceum_warp.algos.planner import MPPI
from lyceum_warp.cli.arguments import NO_FLAGS, ParamWords, Trust, given, optional_flags, parameters
from lyceum_warp.cli.display import note
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.cli.plan import Settings
from lyceum_warp.controllers.saved_episodes import episode_env, load_episodes
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.env import Env
from lyceum_warp.options import EnvOptions
from lyceum_warp.runs.checkpoints import check_sizes
from lyceum_warp.runs.folder import Run, load
from lyceum_warp.support.interrupts import Interrupted, signals
from lyceum_warp.support.validate import whole_number
from lyceum_warp.viewer.follow import Follower, Parent, wait_for_run
from lyceum_warp.viewer.session.clock import Watcher
from lyceum_warp.viewer.session.stage import check_world
from lyceum_warp.viewer.show import chosen_graphics, view

_RUN_WORLDS = 16
_WAIT = 10.0  # seconds that --follow waits for a run
_LONG = 1e9


@optional_flags(EnvOptions, omit=(*NO_FLAGS, "horizon"), default="(default: the run's, or on the cpu)")
class Place:
    """Where the worlds run; with --mppi, where the planner's worlds run."""

    engine: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """mujoco (the C engine, on CPU cores), warp, or auto."""
    device: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """cpu, or a CUDA device such as cuda:0. By default a run with engine auto is shown on the CPU."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Show a task, a policy, a planner or saved episodes in a browser or a window.

    For a task, the viewer shows its worlds, lets you push bodies with the mouse, and with --mppi runs a planner in real
    time. For a run, it shows the run's policy, and with --follow the newest policy while the run trains. Episode files,
    or a folder of lyceum-warp plan, are played back.

    The viewer is a web page. The command prints its address, which contains a secret, and over ssh the command that
    forwards the port. With --gfx native the viewer is a window, on a machine with a display.

    $ lyceum-warp view hopper
    $ lyceum-warp view runs/hopper-20260101-120000 --which best
    $ lyceum-warp view runs/hopper-20260101-120000 --follow --nworld 64
    $ lyceum-warp view reach --mppi --samples 64
    $ lyceum-warp view runs/plan-reach-20260101-120000/episode-*.npz
    """

    what: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK|RUN|FILE...")]
    """A task's name or file, a run's folder, or episode files."""
    mppi: bool = False
    """Control the shown world with a planner: MPPI, or with --update a different one."""
    follow: bool = False
    """Show the newest policy of a run while it trains."""
    which: str = "last"
    """Which policy of a run: last, best, or the number of a saved iteration."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """The task of a run or of episodes, as a name or a file, if it cannot be found."""
    nworld: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Number of worlds: by default 16 for a run, 1 otherwise."""
    world: int = 0
    """Index of the first shown world."""
    seed: int = 0
    """Seed of the initial states."""
    paused: bool = False
    """Whether to start paused."""
    trace: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The site or body whose path is drawn for each planner sample; by default the task's choice."""
    gfx: Annotated[str, tyro.conf.arg(metavar="web|native")] = "web"
    """web for a browser page, native for a window on this machine's screen."""
    host: str = "127.0.0.1"
    """Address on which to serve the page. The default is reachable only from this machine."""
    port: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Port of the page; by default the first free port from 8080."""
    browser: bool = False
    """Whether to open the page in this machine's browser."""
    param: ParamWords = ()
    trust: Trust = False
    fps: float = 30.0
    """Maximum number of frames per second."""
    place: tyro.conf.OmitArgPrefixes[Place] = dataclasses.field(default_factory=Place)
    planner: tyro.conf.OmitArgPrefixes[Settings] = dataclasses.field(default_factory=Settings)

    def run(self) -> int:
        """Run the command, and return the exit code."""
        return self.show()

    def show(self, parent: Parent | None = None) -> int:
        """Show the viewer until it is closed; return the exit code.

        Args:
            parent: The program that started this one; the viewer ends with it.
        """
        chosen_graphics(self.gfx)
        _check(self)
        torch.set_num_threads(1)
        kind = _kind(self.what)
        for flag, fits in (("follow", ("run",)), ("mppi", ("task", "run")), ("trust", ("run",))):
            if getattr(self, flag) and kind not in fits:
                raise ValueError(f"--{flag} needs a {' or a '.join(fits)}, and {self.what[0]} is not one: omit it")
        shown: dict[str, Any] = {
            name: getattr(self, name) for name in ("world", "paused", "trace", "gfx", "host", "port", "browser", "fps")
        }
        watchers: list[Watcher] = [] if parent is None else [_Ends(parent)]
        if kind == "episodes":
            episodes = load_episodes(self.what)
            env = _episodes_env(self, episodes)
            unique = len({file.name for file in episodes}) == len(episodes)
            named = {file.name if unique else str(file): episode for file, episode in episodes.items()}
            view(env, episodes=named, watchers=watchers, **shown)
            return 0
        controllers: dict[str, Any] = {}
        if kind == "run":
            run = _run(self, parent)
            env = _run_worlds(self, run)
            if self.follow:
                follower = Follower(run, device=env.obs.device)
                check_sizes(follower.policy, env, run.policy_file())
                controllers["policy"] = follower
                watchers.append(follower.update)
            else:
                policy = load(run, which=self.which, device=env.obs.device)
                check_sizes(policy, env, run.policy_file(self.which))
                controllers["policy"] = policy
        else:
            env = _task_worlds(self)
        if self.mppi:
            controllers["mppi"] = _planner(self, env)
        view(env, controllers, seed=self.seed, watchers=watchers, **shown)
        return 0


def _check(options: View) -> None:
    """Refuse numbers out of range and flags without effect, before worlds are made."""
    whole_number("seed", options.seed, low=0)
    if options.nworld is not None:
        whole_number("nworld", options.nworld, low=1)
    if not options.what:
        raise ValueError("view needs a task, a run, or files of episodes")
    settings = given(options.planner)
    if settings and not options.mppi:
        raise ValueError(f"--{next(iter(settings)).replace('_', '-')} is a setting of the planner: add --mppi")


def _kind(what: tuple[str, ...]) -> str:
    """What to show: "task", "run" or "episodes"."""
    first = Path(what[0])
    if first.suffix == ".npz":
        return "episodes"
    if first.is_dir():
        if not (first / "config.json").is_file() and any(first.glob("*.npz")):
            return "episodes"
        run = Run.open(first)
        kind = "episodes" if "planner" in run.config else "run"
    else:
        kind = "task"
    if len(what) > 1 and kind != "episodes":
        raise ValueError(f"one {kind} can be shown at a time, not {len(what)}: {', '.join(what)}")
    return kind


def _episodes_env(options: View, episodes: dict[Path, Trajectory]) -> Env:
    """A world for the playback of episodes."""
    if options.nworld is not None and options.nworld > 1:
        raise ValueError(f"--nworld {options.nworld} has no effect for episodes: omit it")
    check_world(options.world, 1)
    return episode_env(episodes, task=options.task, **parameters(options.param, options))


def _task_worlds(options: View) -> Env:
    params = parameters(options.param, options)
    nworld = options.nworld or 1
    check_world(options.world, nworld)
    if options.mppi and nworld == 1:  # this world is the plant
        return Env(options.what[0], autoreset=False, nthread=1, **params)
    return Env(options.what[0], nworld=nworld, **given(options.place), **params)


def _planner(options: View, env: Env) -> MPPI:
    """The planner, on the engine and device given by the flags."""
    config = options.planner.on_top_of(task_config(env.task.task, None))
    words = given(options.place) | ({} if env.options.model is None else {"model": env.options.model})
    return MPPI(env.task.task, config, seed=options.seed, params=env.given_params, **words)


def _run(options: View, parent: Parent | None) -> Run:
    folder = Path(options.what[0])
    if not options.follow:
        return Run.open(folder)
    if options.which != "last":
        raise ValueError(f"--follow shows the newest policy, not {options.which!r}: omit one of them")
    if parent is None:
        return wait_for_run(folder, seconds=_WAIT)
    return wait_for_run(folder, seconds=_LONG, going_on=lambda: not parent.ended.is_set())


def _run_worlds(options: View, run: Run) -> Env:
    nworld = options.nworld or _RUN_WORLDS
    check_world(options.world, nworld)
    params = parameters(options.param, options)
    return run_worlds(run, options.place, params, nworld=nworld, task=options.task, trust=options.trust)


class _Ends:
    """Ends the viewer when the program that started it ends."""

    def __init__(self, parent: Parent) -> None:
        self._parent = parent

    def __call__(self) -> list[str]:
        if self._parent.ended.is_set():
            raise Interrupted(0)
        return []


def attached() -> None:
    """Run the subprocess of ``lw.RunViewer``, which reads its job from stdin and ends with its parent."""
    parent = Parent()
    job = parent.job
    try:
        with signals():
            View(what=(job["folder"],), follow=True, **job["options"]).show(parent)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        if not parent.ended.is_set():
            note(f"the viewer of {job['folder']} ended: {' '.join(str(error).split())}")
    except Interrupted:
        pass
