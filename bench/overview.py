"""List the experiments with their durations on two cores."""

import experiment
from rich.console import Console
from rich.table import Table


def main() -> None:
    table = Table("experiment", "what it measures", "--short", "whole", box=None, pad_edge=False)
    for name in experiment.NAMES:
        definition = experiment.load(name)
        times = (
            sum(map(definition.estimate, definition.cases(definition.options(short=short)))) for short in (True, False)
        )
        table.add_row(name, definition.summary, *map(experiment.duration, times))
    Console(width=120).print(table)
    print("\nlyceum-warp bench NAME --help     # list the options of an experiment or of another program in bench/")
    print("lyceum-warp bench compare OLD     # compare this working tree with a revision, bit for bit")
    print("lyceum-warp bench plot [NAME]     # draw figures of stored results: bench/results/NAME-MACHINE.png")
    print("lyceum-warp bench tables [NAME]   # write tables of stored results: bench/results/NAME.md")


if __name__ == "__main__":
    main()
