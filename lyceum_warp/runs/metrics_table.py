"""Append to, read and truncate metrics.csv, the table of a run's iterations."""

import contextlib
import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.support.files import replaced


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row. New columns, for example after a change of the task, are empty in earlier rows.

    Args:
        path: The table; it need not exist.
        row: Values by the names of columns. A value of None becomes an empty cell; floats are written with all digits.
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


def read_metrics(path: Path, *, lines: list[str] | None = None) -> list[dict[str, float | None]]:
    """Read the rows. Empty cells become None.

    Args:
        path: The table.
        lines: Lines to read instead of the table's lines.

    Raises:
        ValueError: A cell is not a number, or the rows differ in length.
    """
    reader = csv.DictReader(_lines(path) if lines is None else lines, strict=True)
    try:
        return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
    except (ValueError, TypeError, csv.Error) as error:
        raise ValueError(f"{path} is not a table of metrics: line {reader.line_num}: {error}") from error


def _lines(path: Path) -> list[str]:
    """Read the lines of the table, including line ends."""
    try:
        with path.open(newline="") as file:
            return file.readlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a table of metrics: {error}") from error


def cut_rows(path: Path, iteration: int) -> None:
    """Delete the rows after an iteration, and an incomplete last row.

    Args:
        path: The table; it need not exist.
        iteration: Number of the last iteration to keep. The first row need not be iteration 1.

    Raises:
        ValueError: A row to keep is damaged; the table then does not change.
    """
    if not path.exists():
        return
    lines = _lines(path)
    header = next(csv.reader(lines[:1]), [])
    column = header.index("iteration") if "iteration" in header else None
    kept = []
    for i, line in enumerate(lines):
        number: float = i  # use the line's index if the cell is broken, because read_metrics reports broken lines
        with contextlib.suppress(ValueError, IndexError, csv.Error):
            number = float(next(csv.reader([line]))[column]) if i and column is not None else i
        if line.endswith("\n") and (i == 0 or number <= iteration):
            kept.append(line)
    read_metrics(path, lines=kept)
    if kept != lines:
        with replaced(path) as temporary:
            temporary.write_text("".join(kept), newline="")
