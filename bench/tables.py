"""Write the tables of experiments from stored results as results/NAME.md."""

import dataclasses
import sys
from pathlib import Path

import experiment
import tyro

from lyceum_warp.support.files import replaced


@dataclasses.dataclass(frozen=True)
class Options:
    """Write a page of tables for each experiment with stored results."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of the experiments; by default all that have results."""
    results: Path = experiment.RESULTS
    """Folder with the results; the pages are written to it."""


def main(options: Options) -> int:
    for name, path in experiment.stored(options.names, options.results).items():
        found = experiment.load(name)
        parts = [f"# {name}", f"{found.summary} Written by `lyceum-warp bench tables {name}` from `{path.name}`."]
        machines = experiment.by_machine(experiment.read(path))
        for machine, rows in machines.items():
            parts += [f"## {machine}", experiment.described(rows)]
            if not found.pooled:
                parts += [table.markdown() for table in found.tables(rows)]
        if found.pooled:
            rows = list({experiment.key(row.case): row for rows in machines.values() for row in rows}.values())
            parts += ["## All machines", *(table.markdown() for table in found.tables(rows))]
        page = path.with_suffix(".md")
        with replaced(page) as temporary:
            temporary.write_text("\n\n".join(parts) + "\n")
        print(page)
    return 0


if __name__ == "__main__":
    options = tyro.cli(Options, prog="lyceum-warp bench tables")
    sys.exit(experiment.guarded(lambda: main(options), "tables"))
