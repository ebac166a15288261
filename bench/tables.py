"""Write the tables of experiments from stored results as results/NAME.md."""

import sys

import experiment
import tyro

from lyceum_warp.support.files import replaced


def main(options: experiment.Stored) -> int:
    for name, path in experiment.stored(options.names, options.results).items():
        definition = experiment.load(name)
        source = f"Written by `lyceum-warp bench tables {name}` from `{path.name}`."
        parts = [f"# {name}", f"{definition.summary} {definition.conditions} {source}"]
        machines = experiment.by_machine(experiment.read(path))
        for machine, rows in machines.items():
            parts += [f"## {machine}", experiment.described(rows)]
            if not definition.pooled:
                parts += [table.markdown() for table in definition.tables(rows)]
        if definition.pooled:
            rows = list({experiment.key(row.case): row for rows in machines.values() for row in rows}.values())
            parts += ["## All machines", *(table.markdown() for table in definition.tables(rows))]
        page = path.with_suffix(".md")
        with replaced(page) as temporary:
            temporary.write_text("\n\n".join(parts) + "\n")
        print(page)
    return 0


if __name__ == "__main__":
    options = tyro.cli(experiment.Stored, prog="lyceum-warp bench tables", description=__doc__)
    sys.exit(experiment.guarded(lambda: main(options), "tables"))
