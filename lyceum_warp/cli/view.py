"""Show a task, a policy, a planner or saved episodes: lyceum-warp view."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lyceum_warp.algos import MPPI, check_sizes, task_config
from lyceum_warp.binding import task_names
from lyceum_warp.cli.arguments import ParamWords, Physics, Placement, cameras, given, parameters
from lyceum_warp.cli.display import note
from lyceum_warp.cli.evaluate import better_policy, run_worlds
from lyceum_warp.cli.plan import Settings
from lyceum_warp.controllers import episode_env, load_episodes
from lyceum_warp.core import EnvOptions
from lyceum_warp.env import Env, Policy, start_episodes
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.training import AUTO, Run, load, load_curriculum, pretrained_run, pretrained_text, runs_in
from lyceum_warp.viewer import Follower, Watcher, view


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Show a task, a policy, a planner or episodes in a browser.

    For a task, the viewer shows its worlds, and you can push bodies with the mouse. With --mppi, a planner controls the
    task in real time. For a run, the viewer shows the run's policy. With --follow, it shows the newest policy while the
    run trains. Episode files, or a folder that lyceum-warp plan has written, are played back.

    The viewer is a web page. The command prints its address, which contains a secret. Over ssh, it also prints the
    command that forwards the port.

    $ lyceum-warp view hopper
    $ lyceum-warp view go1_velocity --pretrained
    $ lyceum-warp view runs/hopper-20260101-120000 --which best
    $ lyceum-warp view runs/hopper-20260101-120000 --follow --nworld 64
    $ lyceum-warp view reach --mppi --samples 64
    $ lyceum-warp view runs/plan-reach-20260101-120000/episode-*.npz
    """

    USUAL = ("pretrained", "mppi", "follow", "which", "nworld", "paused", "host", "port", "param", "samples")

    what: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK|RUN|FILE...")]
    """A task's name or file, a run's folder, or episode files."""
    pretrained: bool = False
    """Show the package's pretrained policy of a task."""
    mppi: bool = False
    """Control the displayed world with a planner: MPPI, or the planner that --update selects."""
    follow: bool = False
    """Show the newest policy of a run while it trains."""
    which: str = AUTO
    """The policy of a run to show: auto (the better of the last and the best policy in new episodes), last, best, or
    the number of a saved iteration."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """The task's name or file, if the task of the run or of the episodes cannot be found."""
    nworld: int | None = None
    """Number of worlds: by default 16 for a run, and 1 for anything else."""
    seed: int = 0
    """Seed of the initial states."""
    paused: bool = False
    """Whether to start paused."""
    host: str = "127.0.0.1"
    """Address on which to serve the page. Other machines cannot reach the default address."""
    port: int | None = None
    """Port of the page; by default the first free port from 8080 on."""
    param: ParamWords = ()
    place: Annotated[Placement, tyro.conf.arg(name="world")] = Placement()
    """Engine and device of the displayed worlds. With --mppi, the planner's worlds use them instead."""
    physics: Physics = Physics()
    planner: Settings = Settings()

    def run(self) -> int:
        """Run the command until the viewer is closed, and return the exit code."""
        if not self.what:
            raise ValueError("view needs a task, a run, or files of episodes")
        settings = given(self.planner)
        if settings and not self.mppi:
            raise ValueError(f"--{next(iter(settings)).replace('_', '-')} is a setting of the planner: add --mppi")
        if self.pretrained:
            folder = pretrained_run(" ".join(self.what))
            note(pretrained_text(Run.open(folder)))
            return dataclasses.replace(self, what=(str(folder),), pretrained=False).run()
        torch.set_num_threads(1)
        kind = _kind(self.what)
        for flag, fits in (("follow", ("run",)), ("mppi", ("task", "run"))):
            if getattr(self, flag) and kind not in fits:
                raise ValueError(
                    f"--{flag} needs a {' or a '.join(fits)}, and {self.what[0]} is not one: omit the flag"
                )
        page: dict[str, Any] = {"paused": self.paused, "host": self.host, "port": self.port}
        params = parameters(self.param)
        if kind == "episodes":
            self._play(params, page)
            return 0
        options = given(self.place) | given(self.physics)
        controllers: dict[str, Any] = {}
        watchers: list[Watcher] = []
        if kind == "run":
            run = Run.open(self.what[0])
            env, controllers["policy"] = self._policy(run, options, params)
            if self.follow:
                watchers.append(Follower(run, controllers["policy"]))
        elif self.mppi and self.nworld in (None, 1):  # the planner controls this world
            env_options: dict[str, Any] = {name: options.get(name) for name in ("objects", "cameras")}
            env = Env(self.what[0], EnvOptions(autoreset=False, nthread=1, **env_options), params)
        else:
            nworld = 1 if self.nworld is None else self.nworld
            env = Env(self.what[0], EnvOptions(nworld=nworld).changed(options), params)
        if self.mppi:
            config = self.planner.on_top_of(task_config(env.task.definition))
            options.pop("cameras", None)
            options |= {} if env.options.model is None else {"model": env.options.model}
            controllers["mppi"] = MPPI(env.task.definition, config, seed=self.seed, params=env.given_params, **options)
        view(env, controllers, seed=None if kind == "run" else self.seed, watchers=watchers, **page)
        return 0

    def _play(self, params: dict[str, Any], page: dict[str, Any]) -> None:
        files = load_episodes(self.what)
        names = [file.name for file in files]
        unique = len(set(names)) == len(names)
        episodes = dict(zip(names if unique else map(str, files), files.values(), strict=True))
        seen = {} if self.place.cameras is None else {"cameras": cameras(self.place.cameras)}
        view(episode_env(files, task=self.task, **params, **seen), episodes=episodes, **page)

    def _policy(self, run: Run, options: dict[str, Any], params: dict[str, Any]) -> tuple[Env, Policy]:
        """Return a run's worlds in their first states, and its policy."""
        if self.follow and self.which not in (AUTO, "last"):
            raise ValueError(f"--follow shows the newest policy, not {self.which!r}: omit --follow or --which")
        env = run_worlds(run, options, params, nworld=16 if self.nworld is None else self.nworld, task=self.task)
        which = "last" if self.follow else better_policy(run, self.which, task=self.task)
        policy = load(run, which=which, device=env.obs.device)
        check_sizes(policy, env, f"the policy in {run.policy_file(which)}")
        start_episodes(env, self.seed, None if self.task else load_curriculum(run, which=which))
        return env, policy


def _kind(what: tuple[str, ...]) -> str:
    first = Path(what[0])
    if first.suffix == ".npz":
        return "episodes"
    if first.is_dir():
        # a folder of lyceum-warp plan has a configuration like a run, but no policy
        kind = "episodes" if any(first.glob("*.npz")) and not (first / "policy.pt").is_file() else "run"
    elif first.is_file() and first.suffix != ".py":
        kind = "run"  # Run.open raises the error
    elif ".py" in what[0] or what[0] in (names := task_names()):
        kind = "task"
    else:
        hint = did_you_mean(what[0], [*names, *runs_in(first.parent)], "lyceum-warp tasks lists the tasks")
        raise ValueError(f"there is no task {what[0]!r}, and no folder of this name: {hint}")
    if len(what) > 1 and kind != "episodes":
        raise ValueError(f"one {kind} can be shown at a time, not {len(what)}: {', '.join(what)}")
    return kind
