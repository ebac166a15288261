"""Draw the figures of experiments from stored results, as PNG files."""

import dataclasses
import sys
from pathlib import Path

import experiment
import tyro


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw a figure for each experiment and machine with stored results."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of the experiments; by default all that have results."""
    results: Path = experiment.RESULTS
    """Folder with the results; the figures are written to it."""


def main(options: Options) -> int:
    for name, path in experiment.stored(options.names, options.results).items():
        draw = experiment.load(name).figure
        for machine, rows in experiment.by_machine(experiment.read(path)).items() if draw else ():
            if (figure := draw(rows)) is not None:
                out = options.results / f"{name}-{machine}.png"
                figure.savefig(out, dpi=130)
                print(out)
    return 0


if __name__ == "__main__":
    options = tyro.cli(Options, prog="lyceum-warp bench plot")
    sys.exit(experiment.guarded(lambda: main(options), "plot"))
