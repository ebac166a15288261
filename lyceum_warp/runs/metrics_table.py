"""Append to, read and truncate metrics.csv, the table of a run's iterations."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.support.files import replaced


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row. New columns are empty in earlier rows.

    Args:
        path: The table; it need not exist.
        row: Values by the names of columns. None becomes an empty cell. Floats are written with all digits.
    """
    lines: list[list[str]] = []
    if path.exists():
        with path.open(newline="") as file:
            lines = [next(csv.reader(file), [])]
    known = lines[0] if lines else []
    columns = list(dict.fromkeys([*known, *row]))
    if columns != known:
        if known:
            with path.open(newline="") as file:
                lines = list(csv.reader(file))
        with replaced(path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for line in lines[1:]:
                writer.writerow([*line, *[""] * (len(columns) - len(known))])
    with path.open("a", newline="") as file:
        csv.writer(file).writerow(map(row.get, columns))  # csv writes None as an empty cell


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """Read the rows. An empty cell is None. An incomplete last row is ignored."""
    with path.open(newline="") as file:
        reader = csv.DictReader((line for line in file if line.endswith("\n")), strict=True)
        try:
            return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
        except (ValueError, TypeError, csv.Error) as error:
            raise ValueError(f"{path} is not a table of metrics: line {reader.line_num}: {error}") from error


def cut_rows(path: Path, iteration: int) -> None:
    """Delete the rows after an iteration, and an incomplete last row.

    Args:
        path: The table; it need not exist.
        iteration: The last iteration to keep.
    """
    if not path.exists():
        return
    rows = read_metrics(path)
    with path.open(newline="") as file:
        header, *lines = [line for line in file if line.strip()] or [""]
    numbers = [row.get("iteration") or number for number, row in enumerate(rows, 1)]
    kept = [line for line, number in zip(lines, numbers, strict=False) if number <= iteration]
    if kept != lines:
        with replaced(path) as temporary:
            temporary.write_text("".join([header, *kept]), newline="")
