"""Figures of the experiments, from their results alone, as PNG and SVG.

python bench/plot.py throughput scaling
"""

import dataclasses
import sys
from pathlib import Path

import experiment
import matplotlib
import tyro


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw an experiment's figure for each machine that it has results from."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Experiments; by default all that have results."""
    results: Path = experiment.RESULTS
    """Folder with the results; the figures go there, too."""


def main(options: Options) -> int:
    names = experiment.choose(options.names, experiment.NAMES, what="experiment")
    if not options.names:
        names = tuple(name for name in names if (options.results / f"{name}.jsonl").exists())
    if not names:
        raise FileNotFoundError(f"there are no results in {options.results}: run an experiment first")
    for name in names:
        path = options.results / f"{name}.jsonl"
        if not path.exists():
            raise FileNotFoundError(f"there is no {path}: run the experiment {name} first")
        draw = experiment.load(name).figure
        for machine, rows in experiment.by_machine(experiment.read(path)).items() if draw else ():
            if (figure := draw(rows)) is None:
                continue
            for ending in ("png", "svg"):
                out = options.results / f"{name}-{machine}.{ending}"
                # names of elements that do not change with each drawing, and no date: equal figures are equal files
                with matplotlib.rc_context({"svg.hashsalt": name}):
                    figure.savefig(out, dpi=130, metadata={"Date": None} if ending == "svg" else None)
                print(out)
    return 0


if __name__ == "__main__":
    options = tyro.cli(Options, prog="lyceum-warp bench plot")
    sys.exit(experiment.guarded(lambda: main(options), "plot"))
