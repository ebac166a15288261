"""Export a run's policy: lyceum-warp export."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp.algos.policy_export import check_export, export_policy
from lyceum_warp.cli.display import make_console
from lyceum_warp.runs.folder import Run, load


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write a run's policy, including its observation normaliser, to a file that runs without lyceum_warp.

    An .onnx file has the input "obs", (n, observations) float32 for any n, and the output "action", the mean actions.
    Writing it needs pip install 'lyceum-warp[export]'. torch loads a .pt2 file: torch.export.load(file).module()(obs).

    $ lyceum-warp export runs/hopper-20260101-120000
    $ lyceum-warp export runs/hopper-20260101-120000 --which best --to robot/policy.onnx
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    to: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The file, .onnx or .pt2; by default policy.onnx in the run's folder. An existing file is replaced."""
    which: str = "last"
    """Which policy: last, best, or the number of a saved iteration."""

    def run(self) -> int:
        """Run the command, and return the exit code."""
        path = self.to or self.folder / "policy.onnx"
        check_export(path)
        policy = load(Run.open(self.folder), which=self.which)
        export_policy(policy, path)
        text = f"{path}: {policy.nobs} observations, {policy.nact} actions, {path.stat().st_size / 1e3:.1f} kB"
        make_console().print(text, soft_wrap=True, markup=False)
        return 0
