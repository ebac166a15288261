import csv
from pathlib import Path

import pytest

from lyceum_warp.runs.metrics_table import append_row, cut_rows, read_metrics


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return tmp_path / "metrics.csv"


def test_a_new_column_is_empty_in_earlier_rows(table: Path) -> None:
    """A newer task or package may add a column. The order of the names in a row does not matter."""
    append_row(table, {"iteration": 1, "kl": 0.5})
    append_row(table, {"iteration": 2, "kl": None, "metrics/forward, m": 1.5})
    append_row(table, {"metrics/forward, m": 2.5, "iteration": 3})
    assert read_metrics(table) == [
        {"iteration": 1, "kl": 0.5, "metrics/forward, m": None},
        {"iteration": 2, "kl": None, "metrics/forward, m": 1.5},
        {"iteration": 3, "kl": None, "metrics/forward, m": 2.5},
    ]


def test_numbers_of_metrics_rows_are_read_exactly(table: Path) -> None:
    rows = [{"iteration": i, "value": i / 3, "mean": None if i % 2 else 1e-30, "bad": float("nan")} for i in (1, 2, 3)]
    for row in rows:
        append_row(table, row)
    with table.open(newline="") as file:
        cells = list(csv.reader(file))
    assert cells[0] == ["iteration", "value", "mean", "bad"]
    assert cells[1] == ["1", repr(1 / 3), "", "nan"]
    read = read_metrics(table)
    assert [row["value"] for row in read] == [row["value"] for row in rows]
    assert [row["mean"] for row in read] == [None, 1e-30, None]


def test_metrics_rows_after_the_checkpoint_are_removed(table: Path) -> None:
    cut_rows(table, 2)  # without a table
    for i in (1, 2, 3):
        append_row(table, {"iteration": i, "value": 0.5})
    with table.open("a") as file:
        file.write("4,0.")  # an incomplete row
    whole = table.read_text()
    cut_rows(table, 2)
    assert [row["iteration"] for row in read_metrics(table)] == [1, 2]
    table.write_text(whole)
    cut_rows(table, 9)
    assert [row["iteration"] for row in read_metrics(table)] == [1, 2, 3]
    cut_rows(table, 0)
    append_row(table, {"iteration": 1, "value": 0.5})
    assert [row["iteration"] for row in read_metrics(table)] == [1]


def test_file_that_is_not_a_metrics_table_raises_an_error(table: Path) -> None:
    table.write_text("iteration,value\n1,apple\n")
    with pytest.raises(ValueError, match=r"metrics\.csv is not a table of metrics: line 2"):
        read_metrics(table)
    table.write_text("iteration,value\n1,2,3\n")
    with pytest.raises(ValueError, match="line 2"):
        read_metrics(table)


@pytest.mark.parametrize("place", [0, 12, 16])
def test_metrics_table_with_an_invalid_byte_raises_an_error_and_is_not_changed(place: int, table: Path) -> None:
    damaged = bytearray(b"iteration,value\n1,2\n2,3\n")
    damaged[place] = 0xFF
    table.write_bytes(damaged)
    for read in (lambda: read_metrics(table), lambda: cut_rows(table, 1)):
        with pytest.raises(ValueError, match=r"metrics\.csv is not a table of metrics"):
            read()
    assert table.read_bytes() == damaged
