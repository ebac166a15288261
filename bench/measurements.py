"""Files of measurements: the results with their machine and versions, and a comparison of two files.

    python bench/measurements.py old.json new.json

Numbers of different hardware are not compared: the difference would be the hardware's.
"""

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from lyceum_warp.support.versions import versions

HARDWARE = ("cpu", "cores", "gpu", "driver", "power_limit")
"""Entries that must be equal in two files for their numbers to be compared."""

_QUERY = {
    "driver": "driver_version",
    "power_limit": "power.limit",
    "clock_sm": "clocks.sm",
    "clock_sm_max": "clocks.max.sm",
    "clock_memory": "clocks.mem",
    "throttled": "clocks_event_reasons.active",
}


def context(device: str = "cpu") -> dict[str, Any]:
    """Packages, machine, commit; on a GPU its driver, power limit and clocks as they are now."""
    found = versions(device)
    program = shutil.which("nvidia-smi") if device.startswith("cuda") else None
    if program is not None:
        index = device.partition(":")[2] or "0"
        command = [program, f"--id={index}", f"--query-gpu={','.join(_QUERY.values())}", "--format=csv,noheader"]
        done = subprocess.run(command, capture_output=True, text=True)
        values = [value.strip() for value in done.stdout.strip().split(",")]
        if done.returncode == 0 and len(values) == len(_QUERY):
            found |= dict(zip(_QUERY, values, strict=True))
    return found


def write(path: Path, rows: Sequence[Any], device: str = "cpu", **more: Any) -> None:
    """Write rows (dataclasses) with the context of their measurement as JSON.

    Call it right after the measurement, because it reads the clocks as they are now.
    """
    content = {"versions": context(device), "rows": [dataclasses.asdict(row) for row in rows], **more}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")


@dataclasses.dataclass(frozen=True)
class Options:
    """Ratios of the numbers in two files, new by old."""

    old: tyro.conf.Positional[Path]
    """File of a measurement."""
    new: tyro.conf.Positional[Path]
    """File of the same measurement on the same hardware."""


def compare(old: dict[str, Any], new: dict[str, Any]) -> Table:
    """A row for each case that both files have, with the ratios of all numbers.

    Raises:
        ValueError: The files are of different hardware, or of different measurements.
    """
    for name in HARDWARE:
        here, there = new["versions"].get(name), old["versions"].get(name)
        if here != there:
            raise ValueError(
                f"the files are of different hardware: {name} is {there!r} in one and {here!r} in the other"
            )
    rows, others = {case(row): row for row in old["rows"]}, {case(row): row for row in new["rows"]}
    both = [key for key in rows if key in others]
    if not both:
        raise ValueError("the files have no case in common")
    numbers = [name for name, value in rows[both[0]].items() if isinstance(value, float)]
    table = Table("case", *numbers)
    for key in both:
        pairs = [(rows[key].get(name), others[key].get(name)) for name in numbers]
        table.add_row(" ".join(map(str, key)), *("" if not a or b is None else f"{b / a:.3f}" for a, b in pairs))
    return table


def case(row: dict[str, Any]) -> tuple[Any, ...]:
    """The case of a row: its words and whole numbers."""
    return tuple(value for value in row.values() if isinstance(value, (str, int)) and not isinstance(value, bool))


def main(options: Options) -> int:
    files = [json.loads(path.read_text()) for path in (options.old, options.new)]
    try:
        Console().print(compare(*files))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    changed = {k: (v, files[1]["versions"].get(k)) for k, v in files[0]["versions"].items()}
    for name, (before, after) in changed.items():
        if before != after:
            print(f"{name}: {before} before, {after} now")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
