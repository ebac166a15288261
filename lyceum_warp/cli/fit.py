"""Fit model fields to a robot's log: lyceum-warp fit."""

import dataclasses
import datetime
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp.cli.arguments import ParamWords, Physics, given, parameters
from lyceum_warp.cli.display import note, say, say_entries
from lyceum_warp.fitting import Parameter, fit

_Names = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD.ELEMENTS")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit model fields, delays and sensors to a robot's log, and say what the log determines.

    The folder gets fit.json, draws.npz, pictures and report.html. The flag --fitted of other commands,
    and lw.make(..., fitted=FOLDER), use the values. docs/fitting.md describes logs and parameters.

    $ lyceum-warp fit go1_velocity log.npz
    $ lyceum-warp fit arm.xml log.csv --shared "dof_damping.*" --each "kp.*"
    $ lyceum-warp fit go1_velocity hanging.npz --hangs --each "dof_frictionloss.*"
    $ lyceum-warp train go1_velocity --fitted fits/go1_velocity --fitted-draws
    """

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|MODEL")]
    """A task (see lyceum-warp tasks), or a model file: MJCF or URDF with actuators."""
    log: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="LOG ...")]
    """Logs (.npz, .csv), saved episodes, or several of them."""
    shared: _Names = ()
    """A parameter that all matching elements share, such as "dof_armature.*_knee". The flag may be repeated."""
    each: _Names = ()
    """A parameter for each matching element. The flag may be repeated."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The folder of the results; by default fits/NAME-DATE."""
    window: float | None = None
    """Seconds of a window; by default 0.25, or 0.1 if the robot's base moves. Each starts from its own state."""
    held_out: float = 0.2
    """Share of the windows that is held back to measure errors of prediction."""
    samples: int = 128
    """Hypotheses per round of the global search; 0 starts at the nominal values."""
    iterations: int = 30
    """Most Gauss-Newton steps."""
    seed: int = 0
    """Seed of the search."""
    nthread: int = 0
    """Threads; 0 means all cores."""
    hangs: bool = False
    """Whether the robot hung at a fixed base."""
    resume: bool = False
    """Whether to continue a fit in the folder of --out."""
    param: ParamWords = ()
    physics_options: Annotated[Physics, tyro.conf.arg(name="physics")] = Physics()

    def run(self) -> None:
        name = Path(self.model).stem if Path(self.model).suffix else self.model
        out = self.out or Path("fits") / f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        wanted: list[Parameter | str] = [*self.shared, *(Parameter(name=each, each=True) for each in self.each)]
        result = fit(
            self.model, self.log, wanted or None, out=out, window=self.window, held_out=self.held_out,
            samples=self.samples, iterations=self.iterations, seed=self.seed, nthread=self.nthread, hangs=self.hangs,
            resume=self.resume, progress=lambda stage, k, number: note(f"{stage} {k}: {number:.4g}"),
            **given(self.physics_options), **parameters(self.param),
        )  # fmt: skip
        say(result.text)
        say_entries(report=out / "report.html", next=f"lyceum-warp train TASK --fitted {out}")
