"""Write results/tune.md with tables of the results that `lyceum-warp tune --out results/tune-MACHINE.jsonl` stored."""

import json
from collections.abc import Sequence
from typing import Any

from experiment import RESULTS, Table

from lyceum_warp.support.files import replaced
from lyceum_warp.tuning import Difference
from lyceum_warp.tuning.judgement import verdict

TEXT = (
    "# tune\n\nFaster physics at equal returns. Each title names the engine; the task as it is has exact physics. "
    "Verdicts on tasks without terminations use returns alone unless the table gives the fraction of clearly worse "
    "episodes. Written by `lyceum-warp bench tune_page` from {}."
)


def searches(name: str) -> list[list[dict[str, Any]]]:
    """Read the results of all searches from a file. A search's result is a list of settings, the fastest one first."""
    by_search: dict[str, list[dict[str, Any]]] = {}
    for line in (RESULTS / name).read_text().splitlines():
        row = json.loads(line)
        by_search.setdefault(json.dumps(row["identity"]), []).append(row)
    for rows in by_search.values():
        for row in rows:
            row["verdict"] = verdict(row, "strict") if row["physics"] else "reference"
        rows.sort(key=lambda row: -row.get("speedup", 0.0))
    return sorted(by_search.values(), key=lambda rows: (rows[0]["identity"]["task"], not rows[0]["identity"]["short"]))


def fastest(rows: Sequence[dict[str, Any]], *verdicts: str) -> dict[str, Any] | None:
    return next((row for row in rows if row["verdict"] in verdicts), None)


def changes(row: dict[str, Any]) -> str:
    both = [("", row["returns"]), ("clearly worse, ", row.get("clearly_worse", {}))]
    return "; ".join(
        f"{text}{source} {Difference(**interval)}" for text, part in both for source, interval in part.items()
    )


def worlds_table(machine: str, results: Sequence[Sequence[dict[str, Any]]]) -> Table:
    lines = []
    for rows in results:
        who = rows[0]["identity"]
        exact, same = fastest(rows, "reference"), fastest(rows, "same")
        faster = [row for row in rows if row["verdict"] in ("different", "not shown", "faults")
                  and row["speedup"] > (same["speedup"] if same else 1.0)]  # fmt: skip
        episodes = "first 100 steps" if who["short"] else "whole episodes"
        lines.append([
            who["task"], f"{who['episodes']:,} {episodes}" if who["episodes"] else episodes,
            f"{exact['steps_per_second']:,.0f} ({exact['speedup']:.2f})" if exact else "",
            *((same["name"], f"{same['speedup']:.2f}", changes(same)) if same else ("as it is", "1", "")),
            "; ".join(f"{row['name']}: {row['speedup']:.2f}, {row['verdict']}, {changes(row)}" for row in faster[:2]),
        ])  # fmt: skip
    title = (
        f"{machine}, {results[0][0]['identity']['nworld']} worlds: the fastest setting with the same returns (strict: "
        "within 2 %), under random actions and, where it is named, under a policy. Speed: relative to the task as it "
        "is; the number after steps/s is the task as it is against itself, which shows the noise. Intervals: difference"
        " of returns, %."
    )
    header = ["task", "episodes", "steps/s as it is", "setting", "speed", "returns", "faster, but"]
    return Table(title, header, lines)


def planning_table(machine: str, results: Sequence[Sequence[dict[str, Any]]]) -> Table:
    lines = []
    for rows in results:
        for row in rows:
            if row["verdict"] in ("same", "not shown", "ranks badly") and row["speedup"] > 1.2:
                ranks = [f"{value['mean']:.2f} ({value['low']:.2f})" for value in row["ranks"].values()]
                lines.append([row["identity"]["task"], row["name"], f"{row['speedup']:.2f}", *ranks, row["verdict"]])
    title = (
        f"{machine}, a planner's physics that plan at least 1.2 times as fast: rank correlation of the samples' "
        "returns with the task's own physics, mean (lower bound)."
    )
    return Table(title, ["task", "setting", "speed of a plan", "standing", "moving", "fallen", "verdict"], lines)


def main() -> None:
    names = sorted(path.name for path in RESULTS.glob("tune-*.jsonl"))
    parts = [TEXT.format(", ".join(f"`{name}`" for name in names))]
    for name in names:
        results = searches(name)
        machine = "{device} ({engine} engine)".format(**results[0][0]["identity"])
        planning = [rows for rows in results if "planner" in rows[0]["identity"]]
        worlds = [rows for rows in results if rows not in planning]
        tables = [make(machine, kind) for make, kind in ((worlds_table, worlds), (planning_table, planning)) if kind]
        parts += [table.markdown() for table in tables]
    with replaced(RESULTS / "tune.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n")
    print(RESULTS / "tune.md")


if __name__ == "__main__":
    main()
