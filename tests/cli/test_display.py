"""Tables on the terminal."""

from lyceum_warp.cli import display


def test_the_table_of_a_run_has_at_most_15_rows_with_evaluations_first() -> None:
    rows = [{"iteration": float(i), "mean_return": None} for i in range(1, 101)]
    shown = display._spread(rows)
    assert len(shown) == 15
    assert (shown[0], shown[-1]) == (rows[0], rows[-1])
    for i in range(9, 100, 10):
        rows[i]["mean_return"] = 1.0
    assert [row["iteration"] for row in display._spread(rows)] == [1, *range(10, 101, 10)]
