"""Run programs in bench/: lyceum-warp bench."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp.support.suggestions import did_you_mean

FOLDER = Path(__file__).resolve().parents[2] / "bench"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """Run an experiment or another program from the folder bench/ of a checkout. Without a name, list the experiments.

    All arguments after the name are passed to the program. With --help, the program explains its arguments.

    $ lyceum-warp bench
    $ lyceum-warp bench throughput --short
    $ lyceum-warp bench plot throughput
    $ lyceum-warp bench tables
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")] = "overview"
    """The name of a program in bench/, without .py."""

    def run(self, *arguments: str) -> None:
        if not (FOLDER / "experiment.py").exists():
            raise FileNotFoundError(f"the experiments need a checkout of the repository, and {FOLDER} does not exist")
        programs = [path.stem for path in sorted(FOLDER.glob("*.py")) if "__main__" in path.read_text()]
        if self.name not in programs:
            hint = did_you_mean(self.name, programs, "lyceum-warp bench lists the experiments")
            raise ValueError(f"there is no program {self.name!r} in bench/: {hint}")
        # the program must import the package from this checkout, not an installed one
        path = os.pathsep.join([str(FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        program = [sys.executable, str(FOLDER / f"{self.name}.py"), *arguments]
        os.execve(sys.executable, program, os.environ | {"PYTHONPATH": path})
