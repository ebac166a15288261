"""Sampling throughput: environment steps per second beside native C and other libraries (the paper's figure 1, left).

    lyceum-warp bench throughput --short

Three parts: ``sampling`` steps many worlds on all threads, and native C, which is ``mujoco.rollout`` with the same
substeps on all threads, is the unit; ``single`` steps one world on one thread, and Gymnasium's environment is the
unit; ``kept`` compares our environments with the bare engine under them (see kept.py). contestants.py says what a
sample is, and how each contestant makes it.
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import contestants
import experiment
import kept
from contestants import LABELS
from experiment import Experiment, Row, Table, choose, median_and_range

import lyceum_warp as lw
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.viz.style import finish_axes, new_figure

TASKS = (
    "cartpole", "hopper", "walker2d", "half_cheetah", "swimmer", "ant", "humanoid", "herb_reach", "humanoid_standup",
    "pusher", "reacher", "inverted_pendulum", "inverted_double_pendulum",
)  # fmt: skip
OTHER_TASKS = (*sorted({*lw.task_names()} - {*TASKS}), *kept.FILES)
"""Further tasks that the part kept can measure."""
SHORT_TASKS = ("half_cheetah", "humanoid")
PARTS = {
    "sampling": ("native", "c", "warp", "envpool", "gym-async", "gym-sync", "dm_control"),
    "single": ("gymnasium", "c", "gymnasium-newton", "envpool", "dm_control"),
    "kept": ("c", "warp", "npg"),
}
"""Contestants of each part. The Warp engine takes part on a GPU, or where it is named."""

COLORS = {
    "native": "#3d4654", "c": "#c8502d", "warp": "#e39a6f", "envpool": "#3d6fa5", "gym-async": "#5a8f4e",
    "gym-sync": "#9cc28f", "gymnasium": "#5a8f4e", "gymnasium-newton": "#9cc28f", "dm_control": "#8a6bb1",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Environment steps per second, ours beside native C and other libraries."""

    parts: tuple[str, ...] = ()
    """Parts: sampling, single, kept; by default all."""
    seconds: float = 1.0
    """How long each contestant is timed in each repeat."""
    worlds: int | None = None
    """Number of worlds of our engines and of native C; by default 64 for each thread, and 16,384 on a GPU."""
    apart: bool = False
    """In the part kept, whether the worlds are at different steps of their episodes."""
    policy: Path | None = None
    """In the part kept, a run or a file whose mean policy chooses the actions, with one task; else they are random."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    task: str
    repeat: int
    """Also the seed of actions and initial states."""
    contestant: str
    worlds: int
    threads: int
    device: str
    seconds: float
    warm: int
    """Steps before the clock starts; in the part kept, 1 where the worlds are apart."""
    policy: str = ""
    """In the part kept, whose actions are stepped; random ones without it."""


def cases(options: Options) -> list[Case]:
    everything = dict.fromkeys(name for names in PARTS.values() for name in names)
    named = choose(options.contestants, everything, what="contestant")
    tasks = choose(options.tasks, (*TASKS, *OTHER_TASKS), SHORT_TASKS if options.short else TASKS, what="task")
    parts = choose(options.parts, PARTS, what="part")
    threads = options.threads or cpu_cores()
    gpu = options.device.startswith("cuda")
    if options.policy is not None and len(tasks) != 1:
        raise ValueError(f"--policy {options.policy} belongs to one task: name it with --tasks")
    if options.policy is not None and not options.policy.exists():
        raise ValueError(f"there is no policy {options.policy}: give the folder of a run, or the file of a policy")
    repeats = options.repeats or (1 if options.short else 3)
    seconds, warm = (0.2, 20) if options.short else (options.seconds, 100)

    def case(part: str, task: str, repeat: int, name: str) -> Case:
        single = part == "single"
        if single:
            size = 1, 1
        elif options.worlds and name in ("native", "c", "warp", "npg"):
            size = options.worlds, threads
        else:
            size = contestants.worlds("c" if name == "npg" else name, threads, options.device), threads
        device = options.device if name == "warp" else "cpu"
        steps = int(options.apart) if part == "kept" else warm
        policy = str(options.policy) if options.policy and part == "kept" and name != "npg" else ""
        return Case(part, task, repeat, name, *size, device, seconds, steps, policy)

    return [
        case(part, task, repeat, name)
        for part in parts
        for task in tasks
        for repeat in range(1 if part == "kept" else repeats)
        for name in PARTS[part]
        if name in named and (name != "warp" or gpu or options.contestants)
        and (name != "npg" or task == tasks[0])
        and (part == "kept" or (task in TASKS and contestants.takes_part(name, task)))
    ]  # fmt: skip


def estimate(case: Case) -> float:
    if case.part == "kept":
        return 15.0 * case.seconds
    return 3.0 + case.seconds * (4.0 if case.contestant == "native" else 2.0)


def measure(case: Case, options: Options) -> dict[str, Any]:
    if case.part == "kept":
        engine = "warp" if case.contestant == "warp" else "mujoco"
        with experiment.cores(case.threads):
            return kept.measure(kept.Setting(
                case.task, case.worlds, engine, case.device, case.threads, max(5, int(30 * case.seconds)),
                apart=bool(case.warm), npg=case.contestant == "npg", policy=Path(case.policy) if case.policy else None,
            ))  # fmt: skip
    return contestants.measure(
        case.contestant, case.task, worlds=case.worlds, threads=case.threads, device=case.device, seed=case.repeat,
        seconds=case.seconds, warm=case.warm,
    )  # fmt: skip


# what is made of the results


def grouped(rows: Sequence[Row], part: str) -> dict[str, list[Row]]:
    """Rows of a part for each task, in the order of TASKS."""
    tasks = [*TASKS, *sorted({row.case["task"] for row in rows} - {*TASKS})]
    found = {task: [row for row in rows if (row.case["part"], row.case["task"]) == (part, task)] for task in tasks}
    return {task: same for task, same in found.items() if same}


def rates(rows: Sequence[Row], contestant: str) -> list[float]:
    return [row.result["env_steps_per_second"] for row in rows if row.case["contestant"] == contestant]


def present(groups: dict[str, list[Row]], part: str) -> list[str]:
    """Contestants of a part that have results."""
    return [name for name in PARTS[part] if any(rates(rows, name) for rows in groups.values())]


def tables(rows: Sequence[Row]) -> list[Table]:
    made = []
    for part, unit, title in (
        ("sampling", "native", "Environment steps per second, and their ratio to native C's"),
        ("single", "gymnasium", "One world on one thread: environment steps per second, ratio to Gymnasium's"),
    ):
        if not (groups := grouped(rows, part)):
            continue
        names = present(groups, part)
        lines = []
        for task, same in groups.items():
            ratios = experiment.paired(same, "env_steps_per_second", unit)
            cells = [median_and_range(_median(rates(same, name)), ",.0f") for name in names]
            beside = ["" if name == unit else median_and_range(ratios.get(name, [])) for name in names]
            lines.append(
                [task, *(f"{cell}; {ratio}" if ratio else cell for cell, ratio in zip(cells, beside, strict=True))]
            )
        explained = "Medians; ratios of the same repeat, with their smallest and largest"
        made.append(Table(f"{title}. {explained}:", ["task", *(LABELS[name] for name in names)], lines))
    if groups := grouped(rows, "kept"):
        lines = [_kept_line(row) for same in groups.values() for row in same]
        header = ["task", "engine", "worlds", "env steps/s", "of the bare engine's", "added to a step", "refresh",
                  "kB a world"]  # fmt: skip
        made.append(
            Table("Environment beside the bare engine on the same states, in turns of ten steps:", header, lines)
        )
    return made


def _median(values: list[float]) -> list[float]:
    return [statistics.median(values)] if values else []


def _kept_line(row: Row) -> list[str]:
    case, found = row.case, row.result
    task = (
        case["task"]
        + (", sampling of NPG" if case["contestant"] == "npg" else "")
        + (", apart" if case["warm"] else "")
        + (", of a policy" if case["policy"] else "")
    )
    step = case["worlds"] / found["env_steps_per_second"]
    return [
        task, "Warp" if case["contestant"] == "warp" else "C", f"{case['worlds']:,}",
        f"{found['env_steps_per_second']:,.0f}", f"{found['kept']:.1%}",
        f"{found['added_microseconds']:,.0f} µs of {step * 1e3:.2f} ms", f"{found['refresh']:.1%}",
        f"{found['bytes_per_world'] / 1e3:,.1f}",
    ]  # fmt: skip


def figure(rows: Sequence[Row]) -> Any:
    """Ratios to the unit, as bars for each task; the unit is the line at 1. None without anything to compare."""
    drawn = []
    for part, unit in (("sampling", "native"), ("single", "gymnasium")):
        ratios = {
            task: experiment.paired(same, "env_steps_per_second", unit) for task, same in grouped(rows, part).items()
        }
        names = [name for name in PARTS[part] if name != unit and any(found.get(name) for found in ratios.values())]
        if names:
            drawn.append((part, unit, names, ratios))
    if not drawn:
        return None
    made = new_figure("throughput", 9.5, 0.6 + 3.0 * len(drawn))
    panels = made.subplots(len(drawn), 1, squeeze=False)[:, 0]
    for axes, (part, unit, names, ratios) in zip(panels, drawn, strict=True):
        width = 0.8 / len(names)
        for k, name in enumerate(names):
            there = [(i, values) for i, found in enumerate(ratios.values()) if (values := found.get(name))]
            middles = [statistics.median(values) for _, values in there]
            error = [
                [middle - min(values) for middle, (_, values) in zip(middles, there, strict=True)],
                [max(values) - middle for middle, (_, values) in zip(middles, there, strict=True)],
            ]
            places = [i + (k - (len(names) - 1) / 2) * width for i, _ in there]
            axes.bar(
                places, middles, width, yerr=error, color=COLORS[name], ecolor="#555", error_kw={"linewidth": 0.8},
                label=LABELS[name],
            )  # fmt: skip
        axes.axhline(1.0, color=COLORS["native"], linewidth=1.0)
        if part == "sampling":
            every = [1.0, *(ratio for found in ratios.values() for name in names for ratio in found.get(name, ()))]
            axes.set_yscale("log")
            axes.set_yticks([0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100])
            axes.minorticks_off()
            axes.set_ylim(0.7 * min(every), 1.4 * max(every))
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks(range(len(ratios)), [task.replace("_", "\n") for task in ratios], fontsize="small")
        axes.set_ylabel(f"env steps per second,\n{LABELS[unit]} = 1")
        threads = max(row.case["threads"] for row in rows if row.case["part"] == part)
        axes.set_title(f"{threads} threads" if part == "sampling" else "one world, one thread", loc="left")
        axes.legend(
            frameon=False, ncols=len(names), fontsize="small", columnspacing=1.2, handlelength=1.4, loc="lower right",
            bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1,
        )  # fmt: skip
    finish_axes(panels)
    return made


EXPERIMENT = Experiment(
    name="throughput",
    summary="Sampling throughput beside native C and other libraries; one world alone.",
    cases=cases,
    estimate=estimate,
    measure=measure,
    tables=tables,
    figure=figure,
    options=Options,
    packages=("envpool",),
)

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
