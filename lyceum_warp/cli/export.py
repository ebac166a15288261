"""Export the policy of a run: lyceum-warp export."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp.algos.policy_export import check_export, export_policy
from lyceum_warp.cli.display import make_console
from lyceum_warp.runs.folder import Run, load


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """Write the policy of a run, with its observation normaliser, to a file that runs without lyceum_warp.

    An .onnx file has the input "obs", (n, observations) float32 with any n, and the output "action", the mean actions.
    It needs pip install 'lyceum-warp[export]'. A .pt2 file is loaded by torch: torch.export.load(file).module()(obs).

    $ lyceum-warp export runs/hopper-20260101-120000
    $ lyceum-warp export runs/hopper-20260101-120000 --which best --to robot/policy.onnx
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    to: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The file, .onnx or .pt2; policy.onnx in the run's folder by default. It is replaced if it exists."""
    which: str = "last"
    """Which policy: last, best, or the number of an iteration that was kept."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        path = self.to or self.folder / "policy.onnx"
        check_export(path)
        policy = load(Run.open(self.folder), which=self.which)
        export_policy(policy, path)
        text = f"{path}: {policy.nobs} observations, {policy.nact} actions, {path.stat().st_size / 1e3:.1f} kB"
        make_console().print(text, soft_wrap=True, markup=False)
        return 0
