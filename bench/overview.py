"""The experiments of this folder, with the time that they take on two cores."""

import importlib
import importlib.util

import experiment
from rich.console import Console
from rich.table import Table


def main() -> None:
    table = Table("experiment", "what it measures", "--short", "whole", box=None, pad_edge=False)
    for name in experiment.NAMES:
        if importlib.util.find_spec(name) is None or not hasattr(importlib.import_module(name), "EXPERIMENT"):
            continue
        found = experiment.load(name)
        times = (sum(map(found.estimate, found.cases(found.options(short=short)))) for short in (True, False))
        table.add_row(name, found.summary, *map(experiment.duration, times))
    Console(width=120).print(table)
    print("\nlyceum-warp bench NAME --help     options of an experiment; every program in bench/ runs in this way")
    print("lyceum-warp bench compare OLD     every difference, to the bit, between a revision and this working tree")
    print("lyceum-warp bench plot [NAME]     figures from the results alone, as PNG and SVG")
    print("lyceum-warp bench tables [NAME]   tables of bench/README.md from the results alone")
    print("lyceum-warp bench peers [NAME]    virtual environments of peers, ahead of time")


if __name__ == "__main__":
    main()
