"""Draw the figures of experiments from stored results, as PNG files."""

import sys

import experiment
import tyro


def main(options: experiment.Stored) -> int:
    for name, path in experiment.stored(options.names, options.results).items():
        draw = experiment.load(name).figure
        for machine, rows in experiment.by_machine(experiment.read(path)).items() if draw else ():
            if (figure := draw(rows)) is not None:
                out = options.results / f"{name}-{machine}.png"
                figure.savefig(out, dpi=130)
                print(out)
    return 0


if __name__ == "__main__":
    options = tyro.cli(experiment.Stored, prog="lyceum-warp bench plot", description=__doc__)
    sys.exit(experiment.guarded(lambda: main(options), "plot"))
