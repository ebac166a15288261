"""Train a policy: lyceum-warp train."""

import dataclasses
import datetime
import functools
import json
import logging
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp import algos, binding, controllers, core, engines, training, viz  # each name loads at its first use
from lyceum_warp.cli import arguments
from lyceum_warp.cli.display import console, curve_table, note, say, say_entries, tried
from lyceum_warp.core import EnvOptions, PhysicsOptions
from lyceum_warp.support.interrupts import Interrupted, obeyed
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.outlines import outline
from lyceum_warp.support.validate import whole_number

_CONFIGS = {
    name.removesuffix("Config").lower(): outline("lyceum_warp.algos", name)
    for name in ("NPGConfig", "PPOConfig", "SACConfig", "DistillConfig")
}
"""The hyperparameters of each of ``training.ALGORITHMS``. Their own classes come with torch."""

_SETTINGS = {"target_return": None, "keep_every": 0, "save_every": 0, "tensorboard": False, "video_every": 0,
             "gate_every": 0, "exact_from": None, "wandb": None}  # fmt: skip
"""Settings that --resume may change, with their default values."""

_RUN_FLAGS = {
    "from_run": "--from", "algorithm": "--algorithm", "teacher": "--teacher", "demonstrations": "--demonstrations",
    "network": "--network", "seed": "--seed", "threads": "--threads", "out": "--out",
}  # fmt: skip
"""Flags that --resume refuses, because a run keeps these settings."""


_SIZES = {"hidden", "activation", "recurrent"}
"""Hyperparameters of the policy's network."""


def _default_texts() -> dict[str, str]:
    """List the algorithms that have a hyperparameter, with their defaults."""
    texts: dict[str, list[str]] = {}
    for algorithm, config in _CONFIGS.items():
        for field in dataclasses.fields(config):
            default = getattr(config, field.name)
            text = " ".join(map(str, default)) if isinstance(default, tuple) else "" if default is None else default
            texts.setdefault(field.name, []).append(f"{algorithm} {text}".strip())
    return {name: f"({', '.join(each)})" for name, each in texts.items()}


class Hyperparameters(arguments.OptionFlags, options=[*_CONFIGS.values()], defaults=_default_texts()):
    """Hyperparameters. For each flag, the help lists the algorithms that have the flag, with their defaults."""

    def on_top_of(self, config: Any, algorithm: str) -> Any:
        """Override a configuration's hyperparameters with the given flags."""
        kind = training.learner_classes(algorithm)[1]
        flags = arguments.given(self)
        owners = {
            name: [key for key, config in _CONFIGS.items() if name in config.__dataclass_fields__] for name in flags
        }
        for name, algorithms in owners.items():
            if algorithm not in algorithms:
                raise ValueError(
                    f"--{name.replace('_', '-')} is a setting of {' or '.join(algorithms)}, not of {algorithm}: "
                    f"omit it, or give --algorithm {' or '.join(algorithms)}"
                )
        return dataclasses.replace(config or kind(), **flags) if algorithm in training.ALGORITHMS else config


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy on a task, with the natural policy gradient, PPO or SAC, or by imitation of a teacher.

    The command writes config.json, metrics.csv (one row per iteration), policy.pt, best.pt, checkpoint.pt and curve.png
    into the run's folder. Ctrl-C saves and ends the run after the current iteration. A second Ctrl-C ends
    it immediately.

    $ lyceum-warp train hopper --iterations 100 --seed 1
    $ lyceum-warp train half_cheetah --param ctrl_cost_weight=0.05 --hidden 32 32
    $ lyceum-warp train path/to/my_task.py --samples 4000 --out runs/mine
    $ lyceum-warp train humanoid --device cuda --solver iterations=4
    $ lyceum-warp train --resume runs/mine --iterations 200
    $ lyceum-warp train hopper --out runs/mine --continue
    $ lyceum-warp train hopper --seeds 5 --jobs 2 --out runs/five
    $ lyceum-warp train my_changed_task.py --from runs/mine --which best
    $ lyceum-warp train hopper --algorithm ppo --iterations 300 --learning-rate 3e-4
    $ lyceum-warp train half_cheetah --algorithm sac --iterations 1000
    $ lyceum-warp train go1_student_velocity --teacher RUN --recurrent 256
    $ lyceum-warp train hopper --algorithm distill --demonstrations runs/seen
    $ lyceum-warp train g1_tracking --clips dances/ walk.csv --device cuda
    $ torchrun --nproc-per-node 2 -m lyceum_warp.cli train hopper --device cuda

    The processes of torchrun share the worlds, even across machines. With --device cuda, each process uses the GPU of
    its local rank. A run can be resumed with a different number of processes. The number changes the results only by
    rounding. After Ctrl-C or SIGTERM, all processes finish the iteration. torchrun waits for them for 30 s, or for its
    --shutdown-timeout.
    """

    USUAL = ("algorithm", "iterations", "seed", "seeds", "out", "go_on", "resume", "nworld", "param", "device")

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """A task's name (see lyceum-warp tasks), or the file of a task: path/to/file.py, or path/to/file.py:Class. With
    --resume, it replaces the file of the run's own task.
    """
    algorithm: Annotated[str | None, tyro.conf.arg(metavar="npg|ppo|sac|distill|FILE")] = None
    """npg (the natural policy gradient), ppo, sac (soft actor-critic with a replay buffer), or distill (imitation of
    --teacher or --demonstrations). The default is the algorithm that the task suggests: ppo for walking robots, npg for
    others. path/to/file.py:Class is a learner of your own, a subclass of lw.Learner. --resume needs this word again.
    """
    teacher: Annotated[str | None, tyro.conf.arg(metavar="RUN|FILE|TASK")] = None
    """The policy that distill imitates: a run's folder (its last policy), a policy's file in this folder, or the name
    of a task with a pretrained policy. The new run stores the policy in teacher.pt.
    """
    demonstrations: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="FILE...")] = None
    """The episodes that distill imitates instead, as written by eval --episodes-to or plan: files or folders."""
    network: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """A network of your own, path/to/file.py:Class: a torch module, made by Class(observations, actions), that computes
    the mean actions of npg, ppo and distill. The run's folder has a copy of the file."""
    iterations: int | None = None
    """Total number of iterations, including those before the run was resumed. The default is the number that the task
    suggests, or 100.
    """
    seed: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Seed of networks, noise and initial states."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N|SEED ...", help_behavior_hint="")] = ()
    """Train this number of seeds, counted from 0, or these seeds, each in a process and a run of its own in --out. The
    same command continues an interrupted training."""
    jobs: int = 1
    """Number of seeds that train at the same time, with --seeds. They share the CPU cores and the GPUs."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The run's folder, which must be new or empty; by default runs/TASK-DATE."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Resume the run in the given folder from its exact state and with its settings, up to --iterations."""
    go_on: Annotated[bool, tyro.conf.arg(name="continue")] = False
    """Start the run in --out, or resume it if it has begun, so that a job can be killed and started again with the same
    command. If the run is complete, only its report is printed.
    """
    from_run: Annotated[Path | None, tyro.conf.arg(name="from", metavar="RUN")] = None
    """Start a new run from the policy, the value function and the normaliser of another run. The other run's settings
    are the defaults. However, a different TASK has its own parameters, and a different --algorithm has its own
    hyperparameters.
    """
    which: str = "last"
    """The policy to start from with --from: last, best, or the number of a saved iteration."""
    target_return: float | None = None
    """End the run once the return of the mean policy reaches this number. With --mean-every 0, the return of the
    sampled episodes is used instead.
    """
    minutes: float | None = None
    """Time limit in minutes. Training ends before an iteration that would probably exceed the limit, judged by the
    longest iteration so far. The first iteration always runs. --resume continues the run."""
    exact_from: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")] = None
    """Number of iterations after which learning goes on in the task's exact physics. The default is the number that the
    task suggests."""
    gate_every: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Test the policy about every INT iterations, and end the run once it passes the gate of the task with two seeds
    (lyceum-warp gate). The tests run beside training on CPU cores, under exact physics. 0 makes no tests."""
    keep_every: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Save the policy in a numbered file every INT iterations. 0 saves only the last and the best policy."""
    save_every: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Save the policy and the complete state every INT iterations, to resume after a crash. 0 saves every 30 s. If
    a save takes less than 0.3 s, the run saves more often, but spends at most 1 % of the time on saves.
    """
    tensorboard: Annotated[bool | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Whether to also write metrics for TensorBoard into the run's folder."""
    wandb: Annotated[str | None, tyro.conf.arg(metavar="PROJECT")] = None
    """The project of Weights & Biases to which the run's settings, metrics and videos are logged."""
    nworld: int | None = None
    """Total number of worlds in all processes. By default 64 (8 with sac), or 4096 per GPU. With npg, each world makes
    samples / nworld steps per iteration. If an episode is longer, an iteration contains only a segment of it.
    """
    threads: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 1)")] = None
    """Number of torch threads on the CPU. PPO divides mini-batches of 512 or more samples among them. Otherwise, small
    networks gain little from more threads, and busy cores gain nothing. Runs are identical bit for bit only with the
    same number of threads. --nthread sets the threads of the mujoco engine.
    """
    param: arguments.ParamWords = ()
    clips: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")] = None
    """Motions for a task that tracks clips, such as g1_tracking: files and folders of the formats that lw.load_clips
    reads. The run's folder has a copy."""
    video: bool = False
    """Whether to write a video of one episode of the trained policy."""
    video_every: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Number of iterations between two videos of the mean policy, such as videos/000100.mp4 in the run's folder. 0
    writes no videos."""
    camera: arguments.CameraWords = ()
    transfer: bool = False
    """Whether to compare the policy's returns between the engines, and between the task's sets of physics options, at
    the end, and write transfer.json. Compiling the kernels of the Warp engine for a CPU may take minutes.
    """
    take_over: bool = False
    """Continue a run that another process has locked, on this or another host. That process ends at its next write."""
    evaluate: bool = False
    """Whether to evaluate the last and the best policy in 32 new episodes at the end, under exact physics on the C
    engine. --video and --require-return do so, too."""
    verbose: bool = False
    """Whether to print the terms of the reward and the other metrics, as in metrics.csv, whenever the mean policy is
    evaluated."""
    plot: bool = True
    """Whether to plot the learning curve at the end."""
    require_return: float | None = None
    """Exit with code 1 unless the return of the trained mean policy exceeds this number."""
    env: Annotated[arguments.EnvFlags, tyro.conf.arg(name="world")] = arguments.EnvFlags()
    physics: arguments.Physics = arguments.Physics()
    hyperparameters: Annotated[Hyperparameters, tyro.conf.arg(name="hyperparameter")] = Hyperparameters()

    def run(self, callbacks: Sequence[Callable[[Any], object]] = ()) -> int:
        self._check_flags()
        if self.seeds:
            from lyceum_warp.cli.seeds import train_and_show

            return train_and_show(self, self.out or _new_folder(binding.task_name(binding.find_task(self.task or ""))))
        folder = self.resume or self.from_run
        source = None if folder is None else training.Run.open(folder)
        with algos.join(self.env.device or ("cpu" if source is None else source.config.get("device", "cpu"))) as team:
            if not team.leads:  # only one process prints messages
                logging.getLogger("lyceum_warp").setLevel(logging.ERROR)
            begun = self.out is not None and self.go_on and team.leads and training.Run.begun(self.out)
            if self.out is not None and team.largest(int(begun))[0]:
                source = training.Run.open(self.out)
                return dataclasses.replace(self, resume=self.out, out=None, from_run=None)._run(source, team, callbacks)
            return self._run(source, team, callbacks)

    def check(self) -> None:
        """Check the settings of a new run, which make a learner or raise an error."""
        self._check_flags()
        source, team = None if self.from_run is None else training.Run.open(self.from_run), algos.Team()
        self._learner(self.configuration(source, team), source, team)
        self._callbacks(self._settings({}))

    def _run(self, source: "training.Run | None", team: "algos.Team", more: Sequence[Callable[[Any], object]]) -> int:
        settings = self._settings({} if source is None else source.config)
        camera = arguments.video_camera(self.camera)
        if camera is not None and not (self.video or settings["video_every"]):
            raise ValueError("--camera has no effect without --video: add --video, or omit --camera")
        with team.together():  # check all options before the folder is created
            configuration = self.configuration(source, team)
            learner, folder, entries = self._learner(configuration, source, team)
            viz.find_camera(learner.env.model, camera)
            callbacks: list[Callable[[Any], object]] = [*self._callbacks(settings), *more]
        total = configuration.iterations
        again = f" --algorithm {configuration.algorithm}" if ".py:" in configuration.algorithm else ""
        hint = f"continue with\n  lyceum-warp train --resume {folder} --iterations {total}{again}"
        if source is not None and self.go_on and self.resume and _is_complete(source, total, settings):
            if team.leads:
                say(f"the run in {folder} is complete")
            return self._report(source, learner) if team.leads else 0
        del settings["wandb"]  # the callback stores it
        changes = {name: settings.pop(name) for name in ("keep_every", "save_every", "exact_from")}
        try:
            run = training.train(
                learner, folder if self.resume is None or source is None else source, total, callbacks=callbacks,
                take_over=self.take_over and self.resume is not None, entries=settings | entries, **changes,
            )  # fmt: skip
        except Interrupted as signalled:
            if team.leads and (folder / "policy.pt").exists():
                self._say_interrupted(folder, signalled, total, hint)
            return 128 + signalled.number
        if not team.leads:
            return 0
        self._say_end(run, learner.iteration, total, hint)
        return self._report(run, learner)

    def _check_flags(self) -> None:
        if self.resume is not None:
            for name, flag in _RUN_FLAGS.items():
                if getattr(self, name) is not None and not (name == "algorithm" and ".py:" in str(self.algorithm)):
                    raise ValueError(f"{flag} has no effect with --resume, which keeps the run's settings: omit it")
        elif self.from_run is None and not self.task:
            raise ValueError(f"train needs a task: one of {', '.join(binding.task_names())}, or path/to/file.py")
        if self.seeds and (self.resume is not None or self.seed is not None or not self.task):
            raise ValueError("--seeds needs a task, and replaces --seed and --resume: omit these")
        if self.jobs != 1 and not self.seeds:
            raise ValueError("--jobs has no effect without --seeds: add --seeds 5, or omit --jobs")
        if self.network is not None and (self.from_run or arguments.given(self.hyperparameters).keys() & _SIZES):
            raise ValueError("--network replaces --from, --hidden, --activation and --recurrent: omit these")
        if self.go_on and self.out is None:
            raise ValueError("--continue needs the run's folder: add --out FOLDER")
        if self.take_over and self.resume is None and not self.go_on:
            raise ValueError("--take-over has no effect without --resume or --continue: omit it")

    def _settings(self, saved: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of ``_SETTINGS``: the flags, those of the source run, or the task's suggestions."""
        settings: dict[str, Any] = {}
        for name, default in _SETTINGS.items():
            settings[name] = saved.get(name, default) if (value := getattr(self, name)) is None else value
        if not saved and self.exact_from is None:
            settings["exact_from"] = self.suggested().exact_from
        if self.resume is None:
            settings["target_return"] = self.target_return
        return settings

    def _say_interrupted(self, folder: Path, signalled: Interrupted, total: int, hint: str) -> None:
        done = training.read_checkpoint(folder / "policy.pt", parts=("iteration",))["iteration"]
        name = signal.Signals(signalled.number).name
        say(f"interrupted by {name} after {done} of {total} iterations{f'; {hint}' if done < total else ''}")
        if self.plot and (folder / "metrics.csv").exists():
            with obeyed():
                say_entries(curve=tried(training.learning_curve, folder))

    def _say_end(self, run: "training.Run", iteration: int, total: int, hint: str) -> None:
        """Say why the run has ended before its last iteration."""
        reached, passed = run.config.get("reached", {}), run.config.get("passed")
        if passed is not None:
            number = passed["iteration"]
            say(f"the policy of iteration {number} passes the gate (tries: {passed['tries']}): lyceum-warp gate "
                f"{run.folder} --which {number}")  # fmt: skip
        if reached.get("iteration") == iteration < total:
            say(f"the target return is reached: {reached['return']:.6g} in iteration {iteration}")
        elif iteration < total and self.minutes is not None:
            say(f"stopped after {iteration} of {total} iterations: the limit is {self.minutes:g} minutes; {hint}")

    def _callbacks(self, settings: Mapping[str, Any]) -> "list[training.Callback]":
        from lyceum_warp.cli.progress import Display  # its base class comes with torch

        display = Display(console, verbose=self.verbose)
        callbacks: list[training.Callback] = [display]
        if settings["target_return"] is not None:
            callbacks.insert(0, training.TargetReturn(settings["target_return"]))
        if every := whole_number("--video-every", settings["video_every"], low=0):
            callbacks.append(training.Videos(every, camera=arguments.video_camera(self.camera), progress=display.work))
        if settings["tensorboard"]:
            callbacks.append(training.TensorBoard())
        if settings["wandb"] is not None:
            callbacks.append(training.WandB(settings["wandb"]))
        if every := whole_number("--gate-every", settings["gate_every"], low=0):
            callbacks.append(training.PassGate(every))
        if self.transfer:
            callbacks.append(training.TransferTest(progress=display.work))
        if self.minutes is not None:
            callbacks.append(training.Minutes(self.minutes))
        return callbacks

    def configuration(self, source: "training.Run | None", team: "algos.Team") -> "training.Configuration":
        """Return the configuration of the ``source`` run, or the task's defaults, with the given flags applied."""
        base = self._suggestion(team) if source is None else training.Configuration.of(source)
        algorithm = self.algorithm or base.algorithm
        if source is not None and self.algorithm is None:
            own = source.config.get("learner")  # older runs and those of a program lack it
            if own is not None or algorithm not in training.ALGORITHMS:
                raise ValueError(
                    f"the run in {source.folder} was trained by {own or algorithm}, a learner of your own: add "
                    f"--algorithm path/to/{own or 'file.py:Class'}"
                )
        if algorithm == "sac" and self.network is not None:
            raise ValueError("sac takes no --network: omit it, or use --algorithm ppo or npg")
        flags = self._given("nworld", "seed") | arguments.given(self.env) | arguments.given(self.physics)
        if "solver" in flags:
            flags["solver"] = {**(base.options.physics.solver or {}), **flags["solver"]}
        options, params = base.options.changed(flags), arguments.parameters(self.param)
        if self.clips is not None:
            from lyceum_warp.cli.clips import clips_of_task

            params["clips"] = clips_of_task(self.clips, self.task or base.task or "", options)
        if source is None or self.task is None or binding.task_name(binding.find_task(self.task)) == source.task_name:
            params = {**base.params, **params}
        hyperparameters = base.hyperparameters if algorithm == base.algorithm else None
        kind, settings = training.learner_classes(algorithm)
        if source is not None and settings is not None and kind.algorithm in source.config:
            hyperparameters = settings(**source.config[kind.algorithm])
        return dataclasses.replace(
            base,
            **self._given("task", "threads", "iterations", "network"),
            options=options,
            params=params,
            algorithm=algorithm,
            hyperparameters=self.hyperparameters.on_top_of(hyperparameters, algorithm),
            seed=base.seed if self.seed is None else None,
        )

    def _suggestion(self, team: "algos.Team") -> "training.Configuration":
        """Return the configuration that the task suggests."""
        suggested, hyperparameters = self.suggested(), None
        try:
            if suggested.settings:
                hyperparameters = training.ALGORITHMS[suggested.algorithm][1](**suggested.settings)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the task {self.task} has an invalid attribute 'training': {error}") from error
        few = 8 if suggested.algorithm == "sac" else 64  # SAC makes an update for each step of each world
        nworld = 4096 * team.size if (self.env.device or "cpu").startswith("cuda") else few
        return training.Configuration(
            task=self.task,
            options=EnvOptions(nworld=nworld, device="cpu", physics=PhysicsOptions(base=suggested.physics)),
            algorithm=suggested.algorithm,
            hyperparameters=hyperparameters,
            iterations=suggested.iterations,
        )

    def suggested(self) -> "core.Training":
        """Return the task's suggestions, or the defaults if a flag chooses another algorithm."""
        assert self.task is not None
        suggested = binding.find_task(self.task).training
        if "fitted" in arguments.given(self.env):  # the values of a fit hold at the model's own time step
            suggested = dataclasses.replace(suggested, physics=None, exact_from=None)
        return suggested if self.algorithm in (None, suggested.algorithm) else core.Training(algorithm=self.algorithm)

    def _given(self, *names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def _learner(
        self, configuration: "training.Configuration", source: "training.Run | None", team: "algos.Team"
    ) -> "tuple[algos.Learner, Path, dict[str, Any]]":
        """Make the learner, the run's folder, and additional entries for config.json."""
        if self.out is not None and team.leads:
            training.Run.check_free(self.out)
        policy = value = None
        entries: dict[str, Any] = {}
        teacher, parts = self._teacher(configuration.algorithm, source)
        if source is not None:
            policy, value, iteration = training.saved_networks(source, self.which if self.resume is None else None)
            algorithm = configuration.algorithm
            named = algorithm in training.ALGORITHMS
            if named and policy is not None and isinstance(policy, algos.SquashedPolicy) != (algorithm == "sac"):
                raise ValueError(
                    f"{source.folder} was trained by {source.config['algorithm']}, whose networks do not fit "
                    f"{algorithm}: omit --algorithm {algorithm}"
                )
            if self.resume is None:
                if algorithm == "ppo" and "value_only" not in arguments.given(self.hyperparameters):
                    alone = 20 if value is None else 0
                    settings = dataclasses.replace(configuration.hyperparameters, value_only=alone)
                    configuration = dataclasses.replace(configuration, hyperparameters=settings)
                entries["from"] = {"run": str(source.folder.resolve()), "which": self.which, "iteration": iteration}
        learner = configuration.learner(team, run=source, networks=(policy, value), teacher=teacher, task=self.task)
        if parts is not None:
            group = getattr(learner, "group", "policy")
            if parts != (expected := learner.env.obs_spaces[group].parts):
                raise ValueError(
                    f"the teacher's observations are {', '.join(parts)}, but the group {group!r} of the task "
                    f"{learner.env.task.name!r} has {', '.join(expected)}: the parts and their sizes must be the same"
                )
            sources = [self.teacher] if self.teacher else list(map(str, self.demonstrations or ()))
            entries["teacher"] = [str(Path(word).resolve()) if Path(word).exists() else word for word in sources]
        if policy is not None:
            fitted = type(learner.config)(**learner.settings())
            for name, value in arguments.given(self.hyperparameters).items():
                if (fitted_value := getattr(fitted, name)) != value:
                    raise ValueError(
                        f"the networks in {self.from_run or self.resume} have {name} {fitted_value}, not {value}: omit "
                        f"--{name.replace('_', '-')}"
                    )
        if source is not None and self.task is None and self.resume is None:
            training.note_changes(source, learner.env)
        return learner, self.resume or self.out or _new_folder(learner.env.task.name), entries

    def _teacher(self, algorithm: str, source: "training.Run | None") -> "tuple[Any, Mapping[str, slice] | None]":
        """Load what distill imitates, and the parts of its observations if they are to be checked."""
        if self.teacher is not None and self.demonstrations is not None:
            raise ValueError("--teacher and --demonstrations are two teachers: omit one of them")
        if algorithm != "distill":
            if self.teacher is not None or self.demonstrations is not None:
                raise ValueError("--teacher and --demonstrations need --algorithm distill")
            return None, None
        if self.demonstrations is not None:
            episodes = list(controllers.load_episodes(self.demonstrations).values())
            return algos.Demonstrations(episodes), {
                name: slice(*place) for name, place in episodes[0].obs_parts.items()
            }
        if self.teacher is None:
            if source is None or not source.teacher.is_file():
                raise ValueError("distill needs a teacher: give --teacher RUN, or --demonstrations FILE...")
            return training.load(source.teacher), None
        from lyceum_warp.cli.evaluate import run_worlds

        path = Path(self.teacher)
        if not path.exists() and self.teacher in training.pretrained_tasks():
            path = training.pretrained_run(self.teacher)
        run = training.Run.open(path.parent if path.is_file() else path)
        return training.load(path), run_worlds(run, engines.options_on_cores(), {}, nworld=1).obs_space.parts

    def _report(self, run: "training.Run", learner: "algos.Learner") -> int:
        env, choice = learner.env, None
        console.print(curve_table(run.rows()))
        if self.evaluate or self.video or self.require_return is not None:
            choice = self._choice(run, learner)
        paths = {"checkpoint": str(run.checkpoint), "metrics": str(run.metrics)}
        if run.best.is_file():
            paths["best"] = str(run.best)
        if run.transfer.is_file():
            say(f"transfer: {json.loads(run.transfer.read_text())['line']}")
        if self.plot:
            paths["curve"] = tried(training.learning_curve, run)
        if self.video and choice is not None:
            camera, path = arguments.video_camera(self.camera), run.folder / "video.mp4"
            policy, seed = training.load(run, which=choice.which), algos.evaluation_seed(env.options.seed + 1)
            paths["video"] = tried(viz.policy_video, env, policy, path, seed, camera=camera)
        paths["next"] = f"lyceum-warp view {run.folder}, or lyceum-warp report {run.folder}"
        if choice is None:
            paths["evaluate"] = f"lyceum-warp eval {run.folder}"
        say_entries(**paths)
        if choice is None:
            return 0
        if self.require_return is not None and not choice.score.mean > self.require_return:
            demand = f"--require-return demands more than {self.require_return:g}"
            note(f"the {choice.which} policy returns {choice.score.mean:.1f}; {demand}")
            return 1
        return 0

    def _choice(self, run: "training.Run", learner: "algos.Learner") -> "training.Choice":
        """Evaluate the last and the best policy, and print the better one's returns."""
        options = {**engines.options_on_cores(), "physics": algos.EXACT}
        judge = functools.partial(algos.evaluation_worlds, learner.env, training.EPISODES, **options)
        with LongWork("evaluating the mean policy", "steps", console) as work:
            choice = training.choose_policy(run, judge, progress=work)
        score = choice.score
        say(f"mean policy, {training.EPISODES} new episodes on the C engine, exact physics: "
            f"return {score.mean:.1f} ± {score.std:.1f} ({score.low:.1f} to {score.high:.1f})")  # fmt: skip
        if len(choice.scores) > 1:
            say(choice.text)
        return choice


def _new_folder(task: str) -> Path:
    return Path("runs", f"{binding.file_name(task)}-{datetime.datetime.now():%Y%m%d-%H%M%S}")


def _is_complete(run: "training.Run", total: int, settings: Mapping[str, Any]) -> bool:
    """Return whether a run has all its iterations, has reached its target return, or has passed its gate."""
    reached, target = run.config.get("reached"), settings["target_return"]
    if reached is not None and target is not None and reached["return"] >= target:
        return True
    passed = settings["gate_every"] and "passed" in run.config
    return bool(passed) or run.read()["iteration"] >= total
