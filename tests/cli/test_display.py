import io

from rich.console import Console

import lyceum_warp as lw
from lyceum_warp.cli import display


def table(rows: list[dict[str, float | None]]) -> str:
    console = Console(file=io.StringIO(), width=80)
    console.print(display.curve_table(rows))
    return console.file.getvalue()


def test_final_table_omits_empty_columns_and_counts_faults() -> None:
    config = lw.NPGConfig(samples=40, rollout="segments", hidden=(4,), value_hidden=(4,))
    first = next(lw.NPG(lw.make("half_cheetah", nworld=4), config=config))
    row = first.row()  # HalfCheetah defines no success, and no episode has ended
    shown = table([row])
    assert "reward" in shown and f"{first.reward_mean:.3g}" in shown
    assert not any(word in shown for word in ("success", "return", "policy", "fault"))
    rows = 2 * [row | {"success": 0.5, "return_mean": 7.25, "faults": 1.0, "outliers": 3.0}]
    shown = " ".join(table(rows).split())
    assert "50%" in shown and "7.2" in shown and "a step" not in shown
    assert "2 faults and 6 outliers in all 2 iterations" in shown
