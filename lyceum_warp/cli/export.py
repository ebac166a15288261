"""Export a run's policy: lyceum-warp export."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp import algos, engines, training
from lyceum_warp.cli.display import note, say, say_entries
from lyceum_warp.cli.evaluate import better_policy, open_run, run_worlds
from lyceum_warp.env import Env, start_episodes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write a run's policy, including its observation normaliser, to a file that can be used without lyceum_warp.

    An .onnx file has the input "obs", (n, observations) float32 for any n, and the output "action", the mean actions.
    The file's metadata describe the robot: parts of observations, joints, gains, control interval and more. ONNX needs
    pip install 'lyceum-warp[export]'. torch loads a .pt2 file: torch.export.load(file).module()(obs).

    $ lyceum-warp export runs/hopper-20260101-120000
    $ lyceum-warp export runs/hopper --which best --to robot/policy.onnx
    $ lyceum-warp export go1_velocity --pretrained
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|TASK")]
    """The run's folder; with --pretrained, the name of a task."""
    pretrained: bool = False
    """Whether to export the package's pretrained policy of a task."""
    to: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The file to write, .onnx or .pt2; by default policy.onnx in the run's folder, or TASK.onnx with --pretrained. An
    existing file is replaced."""
    which: str = training.AUTO
    """The policy to export: auto (the better of the last and the best policy in new episodes), last, best, or the
    number of a saved iteration."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """The file of the run's task, if it has moved, or a different task."""

    def run(self) -> None:
        run = open_run(self.folder, pretrained=self.pretrained)
        path = self.to or (Path(f"{run.folder.name}.onnx") if self.pretrained else run.folder / "policy.onnx")
        algos.check_export(path)
        which = better_policy(run, self.which, task=self.task)
        policy = training.load(run, which=which)
        env = self._env(run, which) if path.suffix == ".onnx" else None
        physics = None if env is None else training.learned_physics(run, env.task.definition, which)
        algos.export_policy(policy, path, env=env, physics=physics)
        say(f"{path}: {policy.nobs} observations, {policy.nact} actions, {path.stat().st_size / 1e3:.1f} kB")
        say_entries(next="docs/deployment.md runs the policy on a robot")

    def _env(self, run: training.Run, which: str) -> Env | None:
        """Make an environment of the run's task, for the metadata. If the task cannot be loaded, print a message."""
        try:
            env = run_worlds(run, engines.options_on_cores(), {}, nworld=1, task=self.task)
            start_episodes(env, None, training.load_curriculum(run, which=which))
            return env
        except (ValueError, FileNotFoundError, ImportError) as error:
            note(f"the file has no metadata on the robot: {error}")
            return None
