import contextlib
import dataclasses
import io
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

import lyceum_warp as lw
from lyceum_warp.cli import display
from lyceum_warp.training import Run


@pytest.fixture(scope="module")
def npg() -> lw.NPG:
    config = lw.NPGConfig(samples=40, rollout="segments", hidden=(4,), value_hidden=(4,))
    return lw.NPG(lw.make("half_cheetah", nworld=4), config=config)


@pytest.fixture(scope="module")
def first(npg: lw.NPG) -> lw.Iteration:
    """Return an iteration in which no episode ends."""
    return next(npg)


@contextlib.contextmanager
def shown_on(console: Console, npg: lw.NPG, total: int = 10) -> Iterator[display.Display]:
    shown = display.Display(console)
    shown.begin(Run(Path("run"), {}), npg, total)
    console.file.truncate(0)
    console.file.seek(0)
    yield shown
    shown.close()


def test_first_line_shows_task_worlds_algorithm_and_folder(npg: lw.NPG) -> None:
    console = Console(file=io.StringIO(), width=120, highlight=False)
    display.Display(console).begin(Run(Path("run"), {}), npg, 10)
    expected = "half_cheetah: 17 observations, 6 actions; 4 worlds, mujoco engine on cpu, npg; run in run\n"
    assert console.file.getvalue() == expected


def line(npg: lw.NPG, iteration: lw.Iteration, **changes: object) -> str:
    console = Console(file=io.StringIO(), width=120, highlight=False)
    with shown_on(console, npg) as shown:
        shown(dataclasses.replace(iteration, samples_per_second=29_412.0, **changes))
    return console.file.getvalue()


def test_the_first_line_shows_the_reward_if_no_episode_has_ended(npg: lw.NPG, first: lw.Iteration) -> None:
    assert math.isnan(first.return_mean)
    assert line(npg, first, reward_mean=-0.8125) == "iteration    1/10  reward -0.812 a step 29.4k samples/s\n"


def test_iteration_line_omits_unknown_numbers(npg: lw.NPG, first: lw.Iteration) -> None:
    common = {"return_mean": 3072.4, "mean_return": 3117.2}
    assert line(npg, first, **common) == "iteration    1/10  return 3072 (mean policy 3117) 29.4k samples/s\n"
    assert "(mean policy 3117) success 25% 29.4k" in line(npg, first, **common, success=0.25)
    assert "success" not in line(npg, first, **common, success=math.nan)
    assert "return 3072 1 fault 1,200 outliers (mean policy 3117) 29.4k" in line(
        npg, first, **common, faults=1, outliers=1200
    )
    assert "return 3072 2 skipped updates (mean policy 3117) 29.4k" in line(npg, first, **common, skipped_updates=2)


@pytest.mark.parametrize("changes", [{}, {"success": 0.25}, {"success": 1.0, "faults": 12_345, "outliers": 12_345}])
def test_progress_bar_fits_into_80_columns(npg: lw.NPG, first: lw.Iteration, changes: dict[str, object]) -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system=None)
    last = dataclasses.replace(first, iteration=100, return_mean=-123.4567, mean_return=-123.4567, **changes)
    with shown_on(console, npg, 100) as shown:
        shown(last)
    lines = re.sub(r"\x1b\[[^a-zA-Z]*[a-zA-Z]", "", console.file.getvalue()).replace("\r", "\n").splitlines()
    assert max(len(text.rstrip()) for text in lines) <= 80
    assert any("100/100" in text and "return -123.5" in text for text in lines)
    assert all(not changes.get("faults") or "12,345 faults" in text for text in lines if "return" in text)


def table(rows: list[dict[str, float | None]], width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(display.curve_table(rows))
    return console.file.getvalue()


def test_final_table_has_at_most_15_rows_and_prefers_rows_with_evaluations() -> None:
    rows: list[dict[str, float | None]] = [{"iteration": float(i), "mean_return": None} for i in range(1, 101)]
    shown = [int(line) for line in table(rows).split()[2:]]
    assert len(shown) == 15 and (shown[0], shown[-1]) == (1, 100)
    for i in range(9, 100, 10):
        rows[i]["mean_return"] = 1.0
    lines = [line.split() for line in table(rows).splitlines()]
    assert [line[0] for line in lines if line and line[0].isdigit()] == list(map(str, [1, *range(10, 101, 10)]))


def test_final_table_omits_empty_columns_and_counts_faults(first: lw.Iteration) -> None:
    row = first.row()  # HalfCheetah defines no success, and no episode has ended
    shown = table([row])
    assert "reward" in shown and f"{first.reward_mean:.3g}" in shown
    assert not any(word in shown for word in ("success", "return", "policy", "fault"))
    rows = 2 * [row | {"success": 0.5, "return_mean": 7.25, "faults": 1.0, "outliers": 3.0}]
    shown = " ".join(table(rows).split())
    assert "50%" in shown and "7.2" in shown and "a step" not in shown
    assert "2 faults and 6 outliers in all 2 iterations" in shown


def test_table_of_all_columns_fits_into_80_columns(first: lw.Iteration) -> None:
    numbers = {
        "samples": 12_345_678, "return_mean": -1234.56, "return_std": 1234.5, "mean_return": -1234.5,
        "length_mean": 1000.0, "eval_mean": -0.0123, "success": 0.5, "kl": 0.01, "samples_per_second": 1e5,
    }  # fmt: skip
    shown = table([first.row() | numbers] * 3)
    assert max(len(line.rstrip()) for line in shown.splitlines()) <= 80
    assert {"12,345,678", "-1234.6", "1234.5", "-1234.5", "1000", "-0.0123", "50%", "0.010"} <= {*shown.split()}
