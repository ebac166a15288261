"""lyceum-warp train."""

import contextlib
import dataclasses
import datetime
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.console import Console

from lyceum_warp.algos.distributed import Team, join
from lyceum_warp.algos.evaluation import Episodes, evaluate, evaluation_seed, evaluation_worlds
from lyceum_warp.algos.learner import Iteration, Learner, fitted_config
from lyceum_warp.algos.networks import moved
from lyceum_warp.binding.registry import find_task, task_name, task_names
from lyceum_warp.checkpoints import PolicyContent, check_sizes, policy_of, read_checkpoint, value_of
from lyceum_warp.cli.algorithms import ALGORITHMS, AlgorithmName, LearnerFlags, flag, run_algorithm
from lyceum_warp.cli.arguments import (
    NO_FLAGS,
    CameraWords,
    EnvFlags,
    Physics,
    Repeated,
    given,
    parameters,
    portable,
    run_options,
    spelled,
)
from lyceum_warp.cli.display import (
    Display,
    curve_table,
    make_console,
    note,
    plotted,
    policy_video,
    tried,
)
from lyceum_warp.engines.placement import engine_name
from lyceum_warp.env import Env
from lyceum_warp.interrupts import Interrupted
from lyceum_warp.kept_task import KeptTask, run_env, run_params, run_task
from lyceum_warp.machine import cpu_cores
from lyceum_warp.runs import Run
from lyceum_warp.tensorboard import TensorBoard, check_tensorboard
from lyceum_warp.training import check_resumable, checked_settings, learn, reopen, restore
from lyceum_warp.validate import whole_number
from lyceum_warp.versions import versions
from lyceum_warp.viewer.follow import RunViewer
from lyceum_warp.viz.cameras import find_camera, parsed_camera
from lyceum_warp.viz.long_work import LongWork
from lyceum_warp.viz.policy_videos import Videos
from lyceum_warp.viz.video import check_video

_FINAL_EPISODES = 32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy on a task, with the natural policy gradient or with PPO.

    The run's folder then holds config.json, versions.json, metrics.csv (one row for each iteration), policy.pt,
    best.pt, checkpoint.pt, curve.png and video.mp4. Ctrl-C loses at most the current iteration; where iterations are
    short, those since the policy was last saved, which is whenever training has taken 200 times as long as such a save.

    $ lyceum-warp train hopper --iterations 100 --seed 1
    $ lyceum-warp train half_cheetah --param ctrl_cost_weight=0.05 --param reset_noise_scale=0 --hidden 32 32
    $ lyceum-warp train path/to/my_task.py --samples 4000 --out runs/mine
    $ lyceum-warp train humanoid --device cuda --integrator euler --solver iterations=4
    $ lyceum-warp train --resume runs/mine --iterations 200
    $ lyceum-warp train my_changed_task.py --from runs/mine --which best
    $ lyceum-warp train hopper --algorithm ppo --iterations 300 --learning-rate 3e-4
    $ torchrun --nproc-per-node 2 -m lyceum_warp.cli train hopper --device cuda

    Processes that torchrun starts share the worlds, also on several machines. With --device cuda each process takes the
    GPU of its number. Their number changes only the rounding
    of the results, and a run may continue with another number. The first process writes files and messages. After
    Ctrl-C or SIGTERM, to torchrun or to any process, all processes finish the iteration and end together; torchrun
    waits for them for 30 s, or for its --shutdown-timeout.
    """

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """A task's name (see lyceum-warp tasks), or a file with one: path/to/file.py, or path/to/file.py:Class."""
    algorithm: AlgorithmName = "npg"
    """npg, the natural policy gradient; or ppo, proximal policy optimisation."""
    iterations: int = 100
    """Iterations in total, including those before --resume."""
    seed: int = 0
    """Seed of the networks, the noise and the worlds' initial states."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The run's folder, new or empty; runs/TASK-DATE by default."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Continue the run in this folder, exactly and with all its settings, up to --iterations."""
    from_run: Annotated[Path | None, tyro.conf.arg(name="from", metavar="RUN")] = None
    """Begin a new run with the policy, the value function and the normaliser of this one. Settings that are not given
    are those of that run; with another TASK, its parameters are not."""
    which: str = "last"
    """Which policy of --from: last, best, or the number of an iteration that was kept."""
    target_return: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """End the run once the mean policy's return, or without --mean-every the mean return, is at least this."""
    keep_every: int = 0
    """Iterations between two policies that are kept under their numbers, 0 for none. The last and the best one are
    always kept."""
    save_every: int = 0
    """Iterations between two saves of the complete state, from which a run that was killed continues; 0 for a number
    that keeps their time below 0.25 %."""
    tensorboard: bool = False
    """Whether to write the metrics for TensorBoard, too, into the run's folder."""
    nworld: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Worlds of all processes together; by default 64, or 4096 for each GPU. Of npg, each makes samples / nworld steps
    in an iteration: whole episodes where those fit (as in the paper: 10 worlds for 10,000 samples and episodes of 1,000
    steps), otherwise segments of episodes."""
    threads: int = 1
    """Threads of torch on the CPU. Small networks gain little from more. Runs are equal to the bit only with the same
    number. They are not the threads of the mujoco engine, which are --nthread."""
    param: Repeated = ()
    """A parameter of the task as NAME=VALUE, a vector as NAME=0.7,inf, a table as NAME=file.npy; may be given several
    times."""
    video: bool = True
    """Whether to write a video of one episode of the trained policy at the end."""
    video_every: int = 0
    """Iterations between two further videos of the mean policy, videos/000100.mp4 and so on in the run's folder, which
    TensorBoard shows, too; 0 for none."""
    camera: CameraWords = ()
    """Camera of the videos: a name or an index of the model's, "free" for MuJoCo's default free camera, or a part of a
    free camera's pose, as azimuth=90, elevation=-20, distance=3, lookat=0,0,1 or track=BODY; may be given several
    times."""
    view: bool = False
    """Whether to show the newest policy while the run trains, in a viewer with worlds of its own: lyceum-warp view
    FOLDER --follow, which another shell may run as well."""
    plot: bool = True
    """Whether to draw the learning curve at the end."""
    require_return: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Exit with code 1 unless the trained mean policy's return exceeds this."""
    env: tyro.conf.OmitArgPrefixes[EnvFlags] = dataclasses.field(default_factory=EnvFlags)
    physics: tyro.conf.OmitArgPrefixes[Physics] = dataclasses.field(default_factory=Physics)
    learner: tyro.conf.OmitArgPrefixes[LearnerFlags] = dataclasses.field(default_factory=LearnerFlags)


def train(options: Train) -> int:
    """Run the command; returns the exit code."""
    with join(options.env.device) as team:
        with team.together():
            # every mistake in the options is found before the folder is made
            origin, source = _origin(options), None
            if options.from_run is not None and options.task is None:
                source = Run.open(options.from_run)
                options = dataclasses.replace(options, task=run_task(source, note=_silent))
            config, out = _config(options, team, origin, source), _folder(options)
            run = None
            if team.leads:
                Run.check_free(out)
            learner = _learner(config, team, run=source, origin=origin)
            _check_camera(options, learner)
            if team.leads:
                kept = KeptTask.of(learner.env)
                run = Run.create(out, config | kept.config, device=options.env.device)
                kept.write(run)
        return _learn(run, learner, options)


def _origin(options: Train) -> tuple[PolicyContent, Path] | None:
    """The content and the file of the policy that a run begins with; None for a new policy."""
    if options.from_run is None:
        return None
    run = Run.open(options.from_run)
    found = run_algorithm(run.config)
    if (algorithm := found[0].name if found else run.config["algorithm"]) != options.algorithm:
        raise ValueError(
            f"the run in {options.from_run} was trained by {algorithm}, and --from begins with a run of the same "
            f"algorithm: leave out --algorithm {options.algorithm}"
        )
    path = run.policy_file(options.which)
    return read_checkpoint(path, parts=("iteration", "policy", "value")), path


def _config(
    options: Train, team: Team, origin: tuple[PolicyContent, Path] | None = None, run: Run | None = None
) -> dict[str, Any]:
    """The configuration of a new run.

    Args:
        options: The options.
        team: The processes.
        origin: The content and the file of the policy that the run begins with.
        run: The run whose task is used.
    """
    if options.task is None:
        raise ValueError(f"train needs a task: one of {', '.join(task_names())}, or path/to/file.py")
    _check_iterations(options.iterations)
    if options.tensorboard:
        check_tensorboard()
    _check_videos(options)
    find_task(options.task)
    algorithm, nworld = ALGORITHMS[options.algorithm], options.nworld
    hyperparameters = algorithm.config(options.learner)
    settings = checked_settings(
        target_return=options.target_return, keep_every=options.keep_every, save_every=options.save_every
    )
    source = {}
    if origin is not None and options.from_run is not None:
        hyperparameters = _fitted(hyperparameters, *origin)
        place = {"run": str(options.from_run.resolve()), "which": options.which, "iteration": origin[0]["iteration"]}
        source = {"from": place}
    if nworld is None:
        nworld = 4096 * team.size if options.env.device.startswith("cuda") else 64
    others = {name: value for name, value in given(options.env).items() if name not in ("engine", "device")}
    if run is not None:  # a run of Python may have options without flags
        others |= {name: value for name, value in run.config.get("options", {}).items() if name in NO_FLAGS}
    return {
        "algorithm": algorithm.name,
        "task": portable(options.task),
        "params": parameters(options.param, options),
        "physics": options.physics.options().given(),
        "engine": options.env.engine,
        "device": options.env.device,
        "options": others,
        "nworld": nworld,
        "threads": options.threads,
        "seed": options.seed,
        "iterations": options.iterations,
        algorithm.name: algorithm.entry(hyperparameters, nworld),
        **settings,
        **_shown(options),
        **source,
    }


def _shown(options: Train) -> dict[str, Any]:
    """What a run shows on its way, as config.json holds it."""
    return {"tensorboard": options.tensorboard, "video_every": options.video_every}


def _fitted(config: Any, content: PolicyContent, path: Path) -> Any:
    """Hyperparameters with the sizes and the group of loaded networks.

    Raises:
        ValueError: Other sizes, or another group, are given.
    """
    fitted = fitted_config(config, content["policy"]["shape"], content["value"]["shape"])
    for field in dataclasses.fields(config):
        given, saved = getattr(config, field.name), getattr(fitted, field.name)
        if given != saved:  # the flags' defaults are those of the run
            raise ValueError(
                f"the networks in {path} have {field.name} {saved}, not {given}: leave out {flag(field.name)}"
            )
    if fitted.value_group is None:  # the new run's own default would be that of its task
        fitted = dataclasses.replace(fitted, value_group=content["value"]["shape"].get("group", "policy"))
    return fitted


def _folder(options: Train) -> Path:
    name = task_name(find_task(options.task or ""))
    return options.out or Path("runs", f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}")


def saved_options(folder: Path) -> Train:
    """The options that a run was started with.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: The run's configuration is not one of a training.
    """
    config = Run.open(folder).config
    found = run_algorithm(config)
    if found is None and "algorithm" in config:
        raise ValueError(
            f"the run in {folder} was trained by {config['algorithm']!r}, a learner of a program: go on there, by "
            "lw.train(..., resume=True)"
        )
    if found is None:
        raise ValueError(f"{folder / 'config.json'} is not the configuration of a training run")
    algorithm, entry = found
    try:
        known, params = run_options(config)
        for name in ("iterations", "seed", "nworld", "threads"):
            if not isinstance(config[name], int):
                raise TypeError(f"{name} is {config[name]!r}")
        return Train(
            task=config["task"], algorithm=algorithm.name, iterations=config["iterations"], seed=config["seed"],
            resume=folder, nworld=config["nworld"], threads=config["threads"],
            param=tuple(f"{name}={spelled(value)}" for name, value in params.items()),
            target_return=config.get("target_return"), keep_every=config.get("keep_every", 0),
            save_every=config.get("save_every", 0),
            tensorboard=config.get("tensorboard", False), video_every=config.get("video_every", 0),
            env=EnvFlags.of(known), physics=Physics.of(known.physics),
            learner=algorithm.flags(entry),
        )  # fmt: skip
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        text = f"{folder / 'config.json'} is not the configuration of a run of {algorithm.name} ({error})"
        raise ValueError(text) from error


def origin_options(given: Train) -> Train:
    """The options of a run that begins with the policy of another one, before those on the command line.

    Args:
        given: The options on the command line.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: The run's configuration is not one of a training.
    """
    assert given.from_run is not None
    if given.resume is not None:
        raise ValueError("--resume continues a run with its own policy, so it cannot be combined with --from")
    run, saved = Run.open(given.from_run), saved_options(given.from_run)
    same = given.task is None or task_name(find_task(given.task)) == run.task_name
    params = run_params(run, run_options(run.config)[1]) if same else {}
    return dataclasses.replace(
        saved, task=given.task, resume=None, target_return=None, from_run=given.from_run,
        param=tuple(f"{name}={spelled(value)}" for name, value in params.items()),
    )  # fmt: skip


def resume(options: Train, folder: Path) -> int:
    """Run the command with --resume; returns the exit code.

    Args:
        options: The run's options, overridden by those on the command line.
        folder: The run's folder.
    """
    with join(options.env.device) as team:
        with team.together():
            settings = checked_settings(
                target_return=options.target_return, keep_every=options.keep_every, save_every=options.save_every
            )
            if options.tensorboard:
                check_tensorboard()
            _check_videos(options)
            run, learner = _reopened(options, folder, team)
            _check_camera(options, learner)
        if team.leads:
            _warn_of_versions(run)
            reopen(run, learner, iterations=options.iterations, **settings, **_shown(options))
        return _learn(run if team.leads else None, learner, options)


def _reopened(options: Train, folder: Path, team: Team) -> tuple[Run, Learner]:
    """A run, and its algorithm in the state of the checkpoint."""
    run = Run.open(folder)
    if run.config["algorithm"] not in ALGORITHMS:
        raise ValueError(
            f"the run in {folder} was trained by rsl-rl, which ppo has replaced: begin a new run with its policy by "
            f"train --from {folder} --algorithm ppo"
        )
    given, saved = (_settings(o) for o in (options, saved_options(folder)))
    for name, value in given.items():
        if value != saved[name]:
            raise ValueError(
                f"the run in {folder} has {name} {spelled(saved[name])}, not {spelled(value)}, and a run keeps its "
                f"settings: omit the option, or start a new run without --resume"
            )
    if options.out not in (None, folder):
        raise ValueError(f"a resumed run stays in its folder {folder}: omit --out")
    content = run.read(note=note if team.leads else _silent)
    check_resumable(run, content, options.iterations, options.target_return, command=True)
    # a policy that Python gave may have a limit, for which there is no hyperparameter
    given_networks = "from" in run.config or "limit" in content["policy"]["shape"]
    origin = (content, run.checkpoint) if given_networks else None
    learner = _learner(run.config, team, run=run, origin=origin)
    restore(run, learner, content)
    return run, learner


def _settings(options: Train) -> dict[str, Any]:
    """The settings that a resumed run must keep."""
    free = ("iterations", "out", "resume", "video", "plot", "require_return", "learner", "param", "env",
            "physics", "from_run", "which", "target_return", "keep_every", "save_every", "tensorboard",
            "video_every", "camera")  # fmt: skip
    settings = {f.name: getattr(options, f.name) for f in dataclasses.fields(options) if f.name not in free}
    settings["task"] = portable(options.task or "")
    settings["param"] = parameters(options.param, options)
    hyperparameters = vars(ALGORITHMS[options.algorithm].config(options.learner))
    return settings | vars(options.env) | vars(options.physics.options()) | hyperparameters


def _learner(
    config: dict[str, Any], team: Team, *, run: Run | None = None, origin: tuple[PolicyContent, Path] | None = None
) -> Learner:
    """The algorithm of a configuration.

    Args:
        config: The configuration.
        team: The processes.
        run: The run whose task it is, and whose folder may hold a copy of it: the run that is continued, or the one
            that a new run begins with.
        origin: The content and the file with the networks; new networks without it.
    """
    if config["threads"] < 1:
        raise ValueError(f"threads must be at least 1, not {config['threads']}")
    torch.set_num_threads(config["threads"])
    options, params = run_options(config)
    if options.nthread is None and team.neighbours > 1 and _engine(config) == "mujoco":
        options = options.changed({"nthread": max(1, cpu_cores() // team.neighbours)})
    nworld = team.share(config["nworld"])
    own = {"nworld": nworld, "first_world": team.rank * nworld, "device": team.device or config["device"]}
    options = options.changed(own | {"seed": config["seed"]})
    if run is None:
        env = Env(config["task"], options, **params)
    else:
        env = run_env(run, options, params, note=note if team.leads else _silent)
    policy = value = None
    if origin is not None:
        policy, value = policy_of(*origin), value_of(*origin)
        check_sizes(policy, env, origin[1])
    algorithm = ALGORITHMS[config["algorithm"]]
    seed = config.get(f"{algorithm.name}_seed", config["seed"])
    return algorithm.learner(config[algorithm.name], env, (policy, value), seed=seed, team=team)


def _check_videos(options: Train) -> None:
    """Check that the videos on the way can be made.

    Raises:
        ValueError: Their number of iterations is out of range.
        NoVideoError: A package for videos is not installed.
    """
    if whole_number("--video-every", options.video_every, low=0):
        check_video()


def _check_camera(options: Train, learner: Learner) -> None:
    """Refuse a camera that the model does not have, or that no video uses.

    Raises:
        ValueError: It is not valid.
    """
    camera = parsed_camera(options.camera)
    if camera is not None and not (options.video or options.video_every):
        raise ValueError("--camera has no effect with --no-video: leave out one of them")
    find_camera(learner.env.model, camera)


def _silent(line: str) -> None:
    """Print nothing, in processes that do not write."""


def _engine(config: dict[str, Any]) -> str:
    """Name of the engine that a run's configuration selects."""
    return engine_name(config["engine"], config["device"])


def _learn(run: Run | None, learner: Learner, options: Train) -> int:
    """Iterate; the process that has the run writes files and messages."""
    console = make_console()
    display = videos = board = None
    if run is not None:
        board = TensorBoard(run.folder, run.config) if options.tensorboard else None
        console.print(_headline(run, learner, options), soft_wrap=True)
        display = Display(console, learner.iteration, options.iterations)
        seed = evaluation_seed(options.seed + 1)
        videos = Videos(
            learner, run.folder / "videos", options.video_every, seed, board, camera=parsed_camera(options.camera),
            note=note, progress=display.work,
        )  # fmt: skip

    def show(iteration: Iteration) -> None:
        if display is not None and videos is not None:
            display(iteration)
            videos(iteration)

    viewer = RunViewer(run.folder) if options.view and run is not None else contextlib.nullcontext()
    try:
        with viewer, display or contextlib.nullcontext():
            learn(
                run, learner, iterations=options.iterations, callback=show, board=board,
                target_return=options.target_return, keep_every=options.keep_every, save_every=options.save_every,
                resumed=options.resume is not None,
            )  # fmt: skip
    except Interrupted as signalled:
        if run is not None and run.checkpoint.exists():
            # an iteration counts once it is complete; the current one is lost
            done = run.read()["iteration"]
            run.cut(done)
            name = signal.Signals(signalled.number).name
            text = f"interrupted by {name} after {done} of {options.iterations} iterations"
            if done < options.iterations:
                text += f"; continue with\n  lyceum-warp train --resume {run.folder} --iterations {options.iterations}"
            console.print(text, soft_wrap=True, markup=False)
        return 128 + signalled.number
    if run is None:
        return 0
    reached = run.config.get("reached", {})
    if reached.get("iteration") == learner.iteration < options.iterations:
        text = f"the target return is reached: {reached['return']:.6g} in iteration {learner.iteration}"
        console.print(text, soft_wrap=True, markup=False)
    return _report(run, learner, options, console)


def _headline(run: Run, learner: Learner, options: Train) -> str:
    """The task, its worlds and where the run goes."""
    env = learner.env
    processes = f" each in {learner.team.size} processes" if learner.team.size > 1 else ""
    return (
        f"[bold]{env.task.name}[/]: {env.obs_space.size} observations, {env.action_space.size} actions; "
        f"{env.nworld} worlds{processes}, {_engine(run.config)} engine on {options.env.device}, "
        f"{ALGORITHMS[learner.algorithm].sampling(learner)}; run in {run.folder}"
    )


def _report(run: Run, learner: Learner, options: Train, console: Console) -> int:
    """Print the table, evaluate the policy, draw the curve and the video; returns the exit code."""
    rows = run.rows()
    console.print(curve_table(rows))
    few = evaluation_worlds(learner.env, _FINAL_EPISODES)
    with LongWork("evaluating the mean policy", "steps", console) as work:
        episodes = evaluate(few, moved(learner.policy, few), _FINAL_EPISODES, seed=options.seed + 1, progress=work)
    console.print(f"mean policy, {len(episodes.returns)} new episodes: {_returns(episodes)}", soft_wrap=True)
    paths = [("checkpoint", str(run.checkpoint)), ("metrics", str(run.metrics))]
    if (best := run.best_score()) is not None:
        console.print(f"best policy: return {best[1]:.1f} in iteration {best[0]}", soft_wrap=True)
        paths.append(("best", str(run.policy_file("best"))))
    if options.plot:
        paths.append(("curve", plotted(run)))
    if options.video:
        seed = evaluation_seed(options.seed + 1)
        video = policy_video(
            learner.env, learner.policy, run.folder / "video.mp4", seed, camera=parsed_camera(options.camera)
        )  # fmt: skip
        paths.append(("video", video))
        if options.tensorboard and Path(video).is_file():
            shown = tried(lambda: _show_video(run, video, learner.samples))
            if shown.startswith("none: "):
                note(f"TensorBoard does not show the video ({shown.removeprefix('none: ')})")
    for name, path in paths:
        console.print(f"{name + ':':<12}{path}", soft_wrap=True, markup=False)
    final = episodes.returns.mean().item()
    if options.require_return is not None and not final > options.require_return:
        print(
            f"lyceum-warp: the mean policy's return is {final:.1f}; --require-return demands more than "
            f"{options.require_return:g}",
            file=sys.stderr,
        )
        return 1
    return 0


def _show_video(run: Run, video: str, samples: int) -> None:
    """Add a video to a run's TensorBoard."""
    with TensorBoard(run.folder, run.config) as board:
        board.video(video, samples)


def _returns(episodes: Episodes) -> str:
    r = episodes.returns
    return f"return {r.mean():.1f} ± {r.std(correction=0):.1f} ({r.min():.1f} to {r.max():.1f})"


def _warn_of_versions(run: Run) -> None:
    if changed := run.changed(versions(run.config["device"])):
        text = ", ".join(f"{name} {old} then, {new} now" for name, (old, new) in changed.items())
        note(f"versions have changed, so numbers may differ from an uninterrupted run's: {text}")


def _check_iterations(iterations: int) -> None:
    if iterations < 1:
        raise ValueError(f"iterations must be at least 1, not {iterations}")
