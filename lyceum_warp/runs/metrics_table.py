"""The table of a run's iterations, metrics.csv: rows are appended, read and cut off."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.files import replaced


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row. A column that is new, as after an update of the task, is empty in earlier rows.

    Args:
        path: The table, which need not exist.
        row: Values by the names of their columns. None becomes an empty cell; floats keep all their digits.
    """
    columns: list[str] = []
    if path.exists():
        with path.open(newline="") as file:
            columns = next(csv.reader(file), [])
    if new := [name for name in row if name not in columns]:
        cells = []
        if columns:
            with path.open(newline="") as file:
                cells = [line + [""] * len(new) for line in list(csv.reader(file))[1:]]
        columns += new
        with replaced(path) as temporary, temporary.open("w", newline="") as file:
            csv.writer(file).writerows([columns, *cells])
    with path.open("a", newline="") as file:
        values = (row.get(name) for name in columns)
        csv.writer(file).writerow(["" if value is None else value for value in values])


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """Read the rows. An empty cell is None.

    Raises:
        ValueError: A cell is not a number, or the rows differ in length.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
        except (ValueError, TypeError, csv.Error) as error:
            raise ValueError(f"{path} is not a table of metrics: line {reader.line_num}: {error}") from error


def cut_rows(path: Path, iteration: int) -> None:
    """Drop the rows after an iteration, and an incomplete last row.

    Args:
        path: The table, which need not exist.
        iteration: Number of the last iteration to keep. The first row may have another number than 1.
    """
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)
    column = next((i for i, name in enumerate(_cells(lines[0])) if name == "iteration"), None) if lines else None
    kept = [
        line for i, line in enumerate(lines)
        if line.endswith("\n") and (i == 0 or _number_of_row(line, column, i) <= iteration)
    ]  # fmt: skip
    if kept != lines:
        with replaced(path) as temporary:
            temporary.write_text("".join(kept))


def _cells(line: str) -> list[str]:
    return next(csv.reader([line]), [])


def _number_of_row(line: str, column: int | None, otherwise: int) -> float:
    """The iteration of a row; another number where it has no such column."""
    try:
        return otherwise if column is None else float(_cells(line)[column])
    except (ValueError, IndexError, csv.Error):  # read_metrics names the line
        return otherwise
