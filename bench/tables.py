"""The tables of the experiments in bench/README.md, from their results alone.

python bench/tables.py throughput

The tables of an experiment stand between the lines ``<!-- table NAME -->`` and ``<!-- end -->``.
"""

import dataclasses
import re
import sys
from pathlib import Path

import experiment
import tyro

from lyceum_warp.support.files import replaced


@dataclasses.dataclass(frozen=True)
class Options:
    """Write the tables of experiments into a document again."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Experiments; by default all that have results and a place in the document."""
    results: Path = experiment.RESULTS
    """Folder with the results."""
    document: Path = experiment.FOLDER / "README.md"
    """The document."""


def tables(name: str, rows: list[experiment.Row]) -> str:
    """The tables of an experiment, for each machine."""
    parts = []
    for same in experiment.by_machine(rows).values():
        parts.append(experiment.described(same[-1]) + ":")
        parts += [table.markdown() for table in experiment.load(name).tables(same)]
    return "\n\n".join(parts)


def main(options: Options) -> int:
    names = experiment.choose(options.names, experiment.NAMES, what="experiment")
    text = options.document.read_text()
    for name in names:
        path = options.results / f"{name}.jsonl"
        place = re.compile(rf"(<!-- table {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not options.names and not (path.exists() and place.search(text)):
            continue
        if not path.exists():
            raise FileNotFoundError(f"there is no {path}: run the experiment {name} first")
        if not place.search(text):
            raise ValueError(f"{options.document} has no place for it: add <!-- table {name} --> and <!-- end -->")
        new = tables(name, experiment.read(path))
        text = place.sub(lambda found, new=new: f"{found[1]}\n{new}\n\n{found[2]}", text)
        print(f"{options.document}: {name}")
    with replaced(options.document) as path:
        path.write_text(text)
    return 0


if __name__ == "__main__":
    options = tyro.cli(Options, prog="lyceum-warp bench tables")
    sys.exit(experiment.guarded(lambda: main(options), "tables"))
