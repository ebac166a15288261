"""Evaluate a run's policy: lyceum-warp eval."""

import dataclasses
import functools
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lyceum_warp import algos, binding, controllers, training, viz
from lyceum_warp.cli import arguments
from lyceum_warp.cli.clips import print_clips
from lyceum_warp.cli.display import console, say, say_entries, table, tried
from lyceum_warp.core import EnvOptions
from lyceum_warp.engines import options_for_few_worlds, options_on_cores
from lyceum_warp.env import Curriculum, Env, Policy
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.validate import whole_number


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval:
    """Evaluate a run's mean policy in whole episodes, by default with the run's physics, and print statistics.

    If the task's file or model has moved or changed since the run started, the command uses the run's own copy.

    $ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --video
    $ lyceum-warp eval runs/hopper --video --camera track=torso --camera azimuth=45
    $ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --transfer
    $ lyceum-warp eval runs/humanoid-20260101-120000 --physics exact
    $ lyceum-warp eval go1_velocity --pretrained
    $ lyceum-warp eval runs/hopper --episodes 8 --episodes-to runs/hopper-episodes
    $ lyceum-warp eval runs/g1_tracking-20260101-120000 --clips --video
    """

    USUAL = (
        "pretrained", "which", "episodes", "seed", "nworld", "memory", "video", "transfer", "episodes_to", "device",
    )  # fmt: skip

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|TASK")]
    """The run's folder; with --pretrained, the name of a task."""
    pretrained: bool = False
    """Whether to evaluate the package's pretrained policy of a task."""
    which: str = training.AUTO
    """The policy to evaluate: auto (the better of the last and the best policy in new episodes), last, best, or the
    number of a saved iteration."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """The name or file of a task to use instead of the run's task. A different task has its own physics and parameters,
    and observations and actions of the same sizes.
    """
    param: arguments.ParamWords = ()
    episodes: int = 32
    """Number of episodes."""
    seed: int = 1
    """Seed of the initial states. Training draws different initial states, even with the same seed."""
    nworld: int = 32
    """Maximum number of worlds."""
    memory: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE[,VALUE...]")] = ()
    """A curriculum's memory at the start of the episodes, such as level=0,5,9. With several values, the command plays
    --episodes for each. By default, curricula stand where they stood when the policy was saved.
    """
    fresh_memory: bool = False
    """Whether curricula begin anew, as in a new run."""
    video: bool = False
    """Whether to write a video of one episode: eval.mp4 in the run's folder, or TASK.mp4 with --pretrained."""
    camera: arguments.CameraWords = ()
    transfer: bool = False
    """Whether to play the episodes on both engines and under each set of physics options that the task defines. The
    command then prints the differences and a verdict. The Warp engine runs on --device, by default on a GPU if there is
    one.
    """
    clips: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="[FILE ...]", help_behavior_hint="")] = None
    """Play every clip of a tracking task once from its first frame, without noise, and print its errors: on the C
    engine under exact physics, and in the run's simulation. Files and folders of motions replace the run's clips
    (lw.load_clips). With --video, a picture shows the worst moment of each clip.
    """
    episodes_to: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """A new or empty folder for the episodes. Each episode is one file, such as episode-000.npz."""
    env: Annotated[arguments.EnvFlags, tyro.conf.arg(name="world")] = arguments.EnvFlags()
    physics: arguments.Physics = arguments.Physics()

    def run(self) -> None:
        whole_number("episodes", self.episodes, low=1)
        if self.transfer and self.env.engine is not None:
            raise ValueError("--transfer plays episodes on both engines: omit --engine")
        if self.clips is not None and (self.transfer or self.episodes_to):
            raise ValueError("--clips plays each clip once: omit --transfer and --episodes-to")
        camera = arguments.video_camera(self.camera)
        if self.video:
            viz.check_video()
        elif camera is not None:
            raise ValueError("--camera has no effect without --video: add --video, or omit --camera")
        if self.episodes_to is not None:
            training.Run.check_free(self.episodes_to)
        run = open_run(self.folder, pretrained=self.pretrained)
        nworld = min(self.nworld, self.episodes)
        options = arguments.given(self.env) | arguments.given(self.physics)
        env = run_worlds(run, options, arguments.parameters(self.param), nworld=nworld, task=self.task)
        viz.find_camera(env.model, camera)
        origin = _source(env, run)
        if env.horizon == 0:
            env = algos.evaluation_worlds(env, nworld)
        which = better_policy(run, self.which, task=self.task)
        policy = training.load(run, which=which, device=env.obs.device)
        algos.check_sizes(policy, env, f"the policy in {run.policy_file(which)}")
        place = f"{self.folder} --pretrained" if self.pretrained else self.folder
        if self.clips is not None:
            picture = Path(f"{binding.file_name(env.task.name)}.png") if self.pretrained else run.folder / "clips.png"
            other = any(text.startswith("clips=") for text in self.param)
            names = [] if other else training.table_rows(run, "clips")
            print_clips(env, policy, self.clips, names, picture if self.video else None, camera)
            say_entries(next=f"lyceum-warp view {place}")
            return
        curricula, origin_of_memory = self._curricula(run, which, env)
        if len(curricula) > 1 and (self.transfer or self.episodes_to):
            raise ValueError("--transfer and --episodes-to play at one level: give --memory one value")
        results = []
        with LongWork("evaluating the policy", "steps", console) as work:
            for curriculum in curricula:
                episodes = algos.evaluate(
                    env, policy, self.episodes, seed=self.seed, curriculum=curriculum, progress=work
                )
                results.append(episodes.first(self.episodes))
        folder = training.pretrained_text(run) if self.pretrained else f"in {self.folder}"
        policy_text = "the mean policy" if which == "last" else f"the mean policy {which!r}"
        say(f"{env.task.name}: {self.episodes} episodes of {policy_text} {folder}, on the {algos.simulation(env)}")
        if len(results) > 1:
            _print_levels(results)
        else:
            if text := results[0].curriculum.text:
                say(f"memory at the start ({origin_of_memory}): {text}")
            _print_statistics(env, results[0])
        if self.transfer:
            with LongWork("judging the policy's transfer", "steps", console) as work:
                verdict = algos.transfer(
                    env, policy, max(2, self.episodes), seed=self.seed, curriculum=curricula[0],
                    device=self.env.device, progress=work,
                )  # fmt: skip
            _print_transfer(verdict)
        if self.episodes_to is not None:
            controller = {"name": type(policy).__name__, "run": str(run.folder.resolve()), "which": which}
            say(f"episodes: {_save_episodes(env, policy, self, curricula[0], controller, origin)}")
        if self.video:
            path = Path(f"{binding.file_name(env.task.name)}.mp4") if self.pretrained else run.folder / "eval.mp4"
            seed = algos.evaluation_seed(self.seed)
            say(f"video: {tried(viz.policy_video, env, policy, path, seed, curriculum=curricula[0], camera=camera)}")
        say_entries(next=f"lyceum-warp view {place}")

    def _curricula(self, run: training.Run, which: str, env: Env) -> tuple[list[Curriculum], str]:
        """Return the curricula at which to play, one for each value of --memory, and where they come from."""
        if self.memory and self.fresh_memory:
            raise ValueError("--memory sets the memory that --fresh-memory leaves at its start: omit one of them")
        if not self.memory:
            saved = None if self.fresh_memory or self.task else training.load_curriculum(run, which=which)
            if saved is not None:
                return [saved], "the run's"
            return [Curriculum(shared={name: memory * 0.0 for name, memory in env.shared.items()})], "new"
        curricula = [Curriculum()]
        for name, value in map(arguments.parameter, self.memory):
            values = torch.tensor(value, dtype=torch.float32).reshape(-1)
            if name in env.shared:
                curricula = [dataclasses.replace(one, shared={**one.shared, name: values}) for one in curricula]
            else:
                rows = values.split(env.lasting[name].shape[1] if name in env.lasting else 1)
                curricula = [
                    dataclasses.replace(one, lasting={**one.lasting, name: row[None]})
                    for one in curricula
                    for row in rows
                ]
        return curricula, "as given"


def open_run(folder: Path, *, pretrained: bool) -> training.Run:
    """Open a run's folder, or with ``pretrained`` the package's policy of the task of this name."""
    return training.Run.open(training.pretrained_run(str(folder)) if pretrained else folder)


def better_policy(run: training.Run, which: str, *, task: str | None = None) -> str:
    """Return "last" or "best" for ``AUTO``, and print the choice; return any other ``which`` as it is."""
    if which != training.AUTO:
        return which

    def worlds() -> Env:
        env = run_worlds(run, options_on_cores(), {}, nworld=training.EPISODES, task=task)
        return env if env.horizon else algos.evaluation_worlds(env, training.EPISODES)

    if not run.best.is_file():
        return "last"
    with LongWork("comparing the last and the best policy", "steps", console) as work:
        choice = training.choose_policy(run, worlds, progress=work)
    say(choice.text)
    return choice.which


def _print_levels(results: list[algos.Episodes]) -> None:
    columns = {"memory at the start": [episodes.curriculum.text for episodes in results]}
    for heading, name in (("return", "returns"), ("length", "lengths"), ("evaluation", "evals"), ("success", "success"),
                          ("terminated", "terminated")):  # fmt: skip
        columns[heading] = [f"{getattr(episodes, name).mean().item():.4g}" for episodes in results]
    columns["std of return"] = [f"{episodes.returns.std(correction=0).item():.3g}" for episodes in results]
    console.print(table(columns))


def _print_statistics(env: Env, episodes: algos.Episodes) -> None:
    # terms, ends and what measure writes add up over an episode; other metrics, such as a level, do not
    averaged = env.task.definition.metrics if env.task.functions["measure"] is None else ()
    numbers = {
        "return": episodes.returns, "evaluation at the end": episodes.evals, "last reward": episodes.rewards,
        "length": episodes.lengths,
    }  # fmt: skip
    numbers |= {name: sums for name, sums in episodes.metrics.items() if name not in averaged}
    numbers |= {f"{name}, a step": episodes.step_metrics[name] for name in averaged}
    columns = {"": list(numbers)}
    deviation = functools.partial(torch.std, correction=0)
    for heading, statistic in (("mean", torch.mean), ("std", deviation), ("min", torch.min), ("max", torch.max)):
        columns[heading] = [f"{statistic(values).item():.6g}" for values in numbers.values()]
    console.print(table(columns))
    if env.task.functions["success"] is not None:
        console.print(f"success: {episodes.success.mean().item():.0%}")
    if len(episodes.objects) > 1:
        parts = {name: episodes.select(held) for name, held in episodes.objects.items() if held.any()}
        columns = {"object": list(parts), "episodes": [str(len(part.returns)) for part in parts.values()]}
        for heading, name in (("success", "success"), ("return", "returns")):
            columns[heading] = [f"{getattr(part, name).mean().item():.4g}" for part in parts.values()]
        console.print(table(columns))


def _print_transfer(verdict: algos.Transfer) -> None:
    for comparison in verdict.comparisons:
        differences = comparison.differences
        columns = {
            "": [one.quantity for one in differences],
            comparison.first: [f"{one.first:.6g}" for one in differences],
            comparison.second: [f"{one.second:.6g}" for one in differences],
            "difference": [f"{one.second - one.first:+.3g}" for one in differences],
            "95 % interval": [f"{one.low:+.3g} to {one.high:+.3g}" for one in differences],
            "margin": [f"{one.margin:.3g}" for one in differences],
            "verdict": [one.verdict for one in differences],
        }
        console.print(f"{comparison.second} against {comparison.first}: {comparison.verdict}", soft_wrap=True)
        console.print(table(columns))
        if any(comparison.faults):
            console.print(f"faults: {comparison.faults[0]} and {comparison.faults[1]}")


def run_worlds(
    run: training.Run, options: dict[str, Any], params: dict[str, Any], *, nworld: int, task: str | None = None
) -> Env:
    """Make worlds of a run's task, with the run's options and parameters as defaults.

    The physics is that of the run's last iteration. A different task has its own defaults. With the engine auto and no
    device, the worlds run on the CPU.
    """
    saved = training.Configuration.of(run)
    defaults = saved.options.changed({"seed": 0})
    if (number := run.config.get("exact_from")) is not None:
        done = training.read_checkpoint(run.policy_file(), parts=("iteration",))["iteration"]
        defaults = defaults.changed({"physics": algos.EXACT} if done > number else {})
    if task is None or binding.task_name(binding.find_task(task)) == run.task_name:
        params = {**saved.params, **params}
    else:
        defaults = EnvOptions(engine=defaults.engine, device=defaults.device, nthread=defaults.nthread)
    merged = defaults.changed({"nworld": nworld} | options)
    if "device" not in options:
        merged = merged.changed(options_for_few_worlds(merged.engine, merged.device))
    try:
        env = training.run_env(run, merged, params, task=task)
    except (ValueError, FileNotFoundError) as error:
        run.note_settings(error)
        raise
    if task is None:
        training.note_changes(run, env, model=env.options.physics == saved.options.physics)
    return env


def _save_episodes(
    env: Env, policy: Policy, options: Eval, curriculum: Curriculum, controller: dict[str, Any], source: dict[str, Any]
) -> str:
    """Run the same episodes again, write one file per episode, and return a glob pattern of the files."""
    assert options.episodes_to is not None
    with LongWork("running the episodes that are saved", "steps", console) as work:
        episodes = controllers.policy_episodes(
            env.replicate(autoreset=False), policy, options.episodes, seed=algos.evaluation_seed(options.seed),
            curriculum=curriculum, controller=controller, progress=work,
        )  # fmt: skip
        for number, episode in enumerate(episodes):
            path = options.episodes_to / f"episode-{number:03d}.npz"
            dataclasses.replace(episode, source=source).save(path)
    return str(options.episodes_to / "episode-*.npz")


def _source(env: Env, run: training.Run) -> dict[str, Any]:
    """Return the ``Trajectory.source`` of saved episodes, with the path of the model's copy if it was used."""
    content = controllers.source(env)
    copy = run.config.get("kept", {}).get("model")
    if copy is not None and env.options.model is not None and "model" not in content["options"]:
        content["options"]["model"] = str((run.task_folder / copy).resolve())
    return content
