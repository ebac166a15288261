"""Measure how many goals a policy reaches with each object, and how often it drops the object."""

import dataclasses
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from experiment import Row, Skipped, Table, grouped

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.env import Player
from lyceum_warp.tasks.hands.gates import Turns, turned
from lyceum_warp.viz import STYLES, finish_axes, new_figure

COLOURS = (STYLES[1][0], STYLES[0][0], "0.7")


@dataclasses.dataclass(frozen=True)
class PolicyCase:
    run: str
    policy: str
    engine: str
    device: str
    worlds: int
    """Worlds for each object."""
    steps: int
    seed: int


def measure(case: PolicyCase, folder: Path, which: str) -> dict[str, Any]:
    """Play with the parameters of the task's gate. A world whose object falls starts again."""
    torch.set_num_threads(1)
    run = lw.Run.open(folder)
    task = find_task(run.task_name)
    if task.objects is None or not isinstance(task.gate, Turns):
        raise Skipped(f"the task {run.task_name} of {folder} has no objects that a hand turns")
    names = list(task.objects.models)
    options = {"engine": case.engine, "device": case.device, "objects": names, "horizon": 0}
    env = run_worlds(run, options, task.gate.params, nworld=case.worlds * len(names))
    env.rand_reset(case.seed)
    total, drops = turned(env, Player(lw.load(run, which=which), env), task.gate.metric, case.steps)
    hours, objects = case.steps * env.timestep / 3600.0, env.field("object").flatten()
    parts = {name: objects == index for name, index in env.task.objects.items()}
    return {
        "held_in": list(run_worlds(run, {}, {}, nworld=1).task.objects),
        "goals": {name: interval(total[part]) for name, part in parts.items()},
        "drops": {name: interval(drops[part] / hours) for name, part in parts.items()},
        "some": {name: (total[part] > 0.0).float().mean().item() for name, part in parts.items()},
        "faults": sum(env.fault_counts.values()),
    }


def interval(numbers: torch.Tensor) -> tuple[float, float]:
    """Compute a mean and half of its 95 % interval."""
    return numbers.mean().item(), 1.96 * numbers.std().item() / len(numbers) ** 0.5


def policy_rows(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "policy" in row.case]


def tables(rows: Sequence[Row]) -> list[Table]:
    tables = []
    for (engine, worlds), same in grouped(policy_rows(rows), "engine", "worlds").items():
        seen = sorted_objects(same)
        groups = {name: [name] for name in seen}
        groups |= {f"held {word}": [name for name in seen if seen[name] == (word == "in")] for word in ("in", "out")}
        lines = [
            [group, "in" if seen[names[0]] else "out", *(cell for row in same for cell in cells(row, names))]
            for group, names in groups.items() if names
        ]  # fmt: skip
        header = ["object", "held"]
        for row in same:
            header += [f"{row.case['run']}: goals in 50 s", "at least one", "drops per hour"]
        title = (
            f"Policies with each object on the {engine} engine, {worlds} worlds for 50 s each, with 95 % intervals. An "
            "object that falls starts again. Objects held in were in training."
        )
        tables.append(Table(title, header, lines))
    return tables


def cells(row: Row, names: Sequence[str]) -> list[str]:
    """Return the means over some objects, with equally many worlds of each."""
    texts = []
    for number, digits in (("goals", 2), ("drops", 0)):
        means, halves = zip(*(row.result[number][name] for name in names), strict=True)
        texts.append(f"{statistics.fmean(means):.{digits}f} ± {math.hypot(*halves) / len(halves):.{digits}f}")
    return [texts[0], f"{statistics.fmean(row.result['some'][name] for name in names):.0%}", texts[1]]


def sorted_objects(rows: Sequence[Row]) -> dict[str, bool]:
    """Return whether a policy had each object in training. These come first, and those with most goals first."""
    goals = {name: max(row.result["goals"][name][0] for row in rows) for name in rows[0].result["goals"]}
    seen = {name: any(name in row.result["held_in"] for row in rows) for name in goals}
    return {name: seen[name] for name in sorted(goals, key=lambda name: (not seen[name], -goals[name]))}


def figure(rows: Sequence[Row]) -> Any:
    """Draw goals and drops with each object on the C engine."""
    rows = [row for row in policy_rows(rows) if row.case["engine"] == "mujoco"]
    if not rows:
        return None
    rows.sort(key=lambda row: not row.result["held_in"])
    seen, height = sorted_objects(rows), 0.8 / len(rows)
    plot = new_figure("goals with each object", 8.0, 0.22 * len(seen) + 1.0)
    panels = plot.subplots(1, 2, sharey=True)
    for axes, number in zip(panels, ("goals", "drops"), strict=True):
        for k, row in enumerate(rows):
            means, halves = zip(*(row.result[number][name] for name in seen), strict=True)
            colours = COLOURS[:2] if row.result["held_in"] else COLOURS[2:] * 2
            axes.barh([i + k * height for i in range(len(seen))], means, height, xerr=halves, ecolor="0.3",
                      error_kw={"linewidth": 0.7}, color=[colours[not held] for held in seen.values()])  # fmt: skip
        axes.set(xlabel=f"{number} {'in 50 s' if number == 'goals' else 'per hour'}", ylim=(len(seen), -0.5))
        axes.set_xlim(left=0.0)
    panels[0].set_yticks([i + 0.4 - height / 2 for i in range(len(seen))], list(seen), fontsize="small")
    for label, colour in zip(("held in", "held out", "no objects in training"), COLOURS, strict=True):
        panels[0].barh([0], [0], color=colour, label=label)
    names = f"from above: {', '.join(row.case['run'] for row in rows)}"
    plot.legend(loc="outside upper center", ncols=3, frameon=False, title=names)
    finish_axes(panels)
    return plot
