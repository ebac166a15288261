"""Scaling of sampling with cores, and with worlds on a GPU (the paper's figure 1, right).

    lyceum-warp bench scaling --device cuda

Two parts: ``cores`` gives each contestant 1, 2, 4, ... and all cores, by the affinity of its threads and processes, and
as many worlds for each core as in the experiment throughput; ``worlds`` gives our engines 1 to 131,072 worlds, the C
engine on all cores. contestants.py says what a sample is.
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from typing import Any

import contestants
import experiment
from contestants import LABELS
from experiment import Experiment, Row, Table, choose, median_and_range
from matplotlib.ticker import LogLocator, NullFormatter
from throughput import COLORS, TASKS

from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.viz.style import finish_axes, new_figure

PARTS = {"cores": ("native", "c", "envpool", "gym-async", "dm_control"), "worlds": ("warp", "c")}
"""Contestants of each part. The Warp engine takes part on a GPU, or where it is named."""
UNIT = "native"
"""The contestant of the part ``cores`` that the others are compared with."""

WORLDS = {"warp": (1, 8, 64, 512, 2_048, 8_192, 16_384, 32_768, 65_536, 131_072), "c": (1, 8, 64, 512, 4_096)}
CPU_WORLDS = 512
"""Most worlds of the Warp engine on the CPU."""
FEW_WORLDS = 16_384
"""Up to so many worlds a step is short, and the clock starts late."""
SATURATED = 0.9
"""Share of the highest rate from which on more worlds gain little."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Environment steps per second by cores, and by worlds on a GPU."""

    threads: tuple[int, ...] = ()
    """Numbers of threads; by default 1, 2, 4, ... and all cores."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds of the part worlds; by default up to 131,072."""
    parts: tuple[str, ...] = ()
    """Parts: cores, worlds; by default both."""
    seconds: float = 1.0
    """How long each contestant is timed in each repeat."""


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
    """Steps before the clock starts."""


def cases(options: Options) -> list[Case]:
    everything = dict.fromkeys(name for names in PARTS.values() for name in names)
    named = choose(options.contestants, everything, what="contestant")
    parts = choose(options.parts, PARTS, what="part")
    tasks = choose(options.tasks, TASKS, ("humanoid",), what="task")
    cores, gpu = cpu_cores(), options.device.startswith("cuda")
    doubled = [1 << k for k in range(cores.bit_length()) if 1 << k < cores]
    threads = options.threads or (*doubled, cores)
    repeats = options.repeats or (1 if options.short else 3)
    seconds, warm = (0.2, 20) if options.short else (options.seconds, 100)

    def sizes(name: str) -> list[int]:
        if options.worlds:
            return list(options.worlds)
        most = 64 if options.short else CPU_WORLDS if name == "warp" and not gpu else max(WORLDS[name])
        return [many for many in WORLDS[name] if many <= most]

    by_cores = [
        Case("cores", task, repeat, name, contestants.worlds(name, n, "cpu"), n, "cpu", seconds, warm)
        for task in tasks
        for n in threads
        for repeat in range(repeats)
        for name in PARTS["cores"]
        if name in named and contestants.takes_part(name, task)
    ]
    by_worlds = [
        Case("worlds", task, repeat, name, many, max(threads), device, seconds, warm if many <= FEW_WORLDS else 20)
        for task in tasks
        for repeat in range(repeats)
        for name, device in (("warp", options.device), ("c", "cpu"))
        if name in named and (name != "warp" or gpu or options.contestants)
        for many in sizes(name)
    ]  # fmt: skip
    return [case for part, found in (("cores", by_cores), ("worlds", by_worlds)) if part in parts for case in found]


def estimate(case: Case) -> float:
    return 3.0 + case.seconds * (4.0 if case.contestant == "native" else 2.0)


def measure(case: Case, options: Options) -> dict[str, Any]:
    return contestants.measure(
        case.contestant, case.task, worlds=case.worlds, threads=case.threads, device=case.device, seed=case.repeat,
        seconds=case.seconds, warm=case.warm,
    )  # fmt: skip


# what is made of the results


def by_size(rows: Sequence[Row], part: str, size: str) -> dict[str, dict[str, dict[int, list[float]]]]:
    """Rates of a part by task, contestant and size, smallest size first."""
    found: dict[str, dict[str, dict[int, list[float]]]] = {}
    for row in sorted(rows, key=lambda row: row.case[size]):
        if row.case["part"] == part:
            sizes = found.setdefault(row.case["task"], {}).setdefault(row.case["contestant"], {})
            sizes.setdefault(row.case[size], []).append(row.result["env_steps_per_second"])
    return found


def saturation(sizes: dict[int, list[float]]) -> int:
    """The fewest worlds whose rate is near the highest one."""
    highest = max(map(statistics.median, sizes.values()))
    return next(many for many, values in sizes.items() if statistics.median(values) >= SATURATED * highest)


def tables(rows: Sequence[Row]) -> list[Table]:
    made = []
    for part, size, title in (
        ("cores", "threads", "environment steps per second by cores, and their ratio to one core's"),
        ("worlds", "worlds", "environment steps per second by worlds"),
    ):
        for task, contestants_ in by_size(rows, part, size).items():
            names = [name for name in PARTS[part] if name in contestants_]
            every = sorted({many for sizes in contestants_.values() for many in sizes})
            lines = [[f"{many:,}", *(_cell(contestants_[name], many, part) for name in names)] for many in every]
            if part == "worlds":
                share = f"{SATURATED:.0%} of the highest rate from"
                lines.append([share, *(f"{saturation(contestants_[name]):,}" for name in names)])
            made.append(Table(f"{task}, {title}:", [size, *(LABELS[name] for name in names)], lines))
            if part == "cores" and (others := [name for name in names if name != UNIT]) and UNIT in names:
                title = f"{task}, ratio to {LABELS[UNIT]}'s rate on as many cores"
                made.append(Table(
                    f"{title}. Medians; ratios of the same repeat, with their smallest and largest:",
                    [size, *(LABELS[name] for name in others)],
                    [[f"{many:,}", *map(median_and_range, beside_unit(rows, task, many, others))] for many in every],
                ))  # fmt: skip
    return made


def beside_unit(rows: Sequence[Row], task: str, threads: int, names: Sequence[str]) -> list[list[float]]:
    """Ratios to native C's rate on as many cores, from the same repeats."""
    same = [
        row for row in rows if (row.case["part"], row.case["task"], row.case["threads"]) == ("cores", task, threads)
    ]
    ratios = experiment.paired(same, "env_steps_per_second", UNIT)
    return [ratios.get(name, []) for name in names]


def _cell(sizes: dict[int, list[float]], many: int, part: str) -> str:
    if many not in sizes:
        return ""
    text = median_and_range(sizes[many], ",.0f")
    if part != "cores" or many == 1 or 1 not in sizes:
        return text
    return f"{text}; {statistics.median(sizes[many]) / statistics.median(sizes[1]):.1f}"


def figure(rows: Sequence[Row]) -> Any:
    """The first task's rates: by cores, and by worlds."""
    drawn = [(size, by_size(rows, part, size)) for part, size in (("cores", "threads"), ("worlds", "worlds"))]
    drawn = [(size, groups) for size, groups in drawn if groups]
    made = new_figure("scaling", 0.5 + 4.5 * len(drawn), 4.5)
    panels = made.subplots(1, len(drawn), squeeze=False)[0] if drawn else []
    for axes, (size, groups) in zip(panels, drawn, strict=True):
        task, found = next(iter(groups.items()))
        for name, sizes in found.items():
            middles = [statistics.median(values) for values in sizes.values()]
            low, high = [min(values) for values in sizes.values()], [max(values) for values in sizes.values()]
            axes.fill_between(list(sizes), low, high, color=COLORS[name], alpha=0.2, linewidth=0)
            axes.plot(list(sizes), middles, color=COLORS[name], marker=".", label=LABELS[name])
        if size == "threads" and UNIT in found and 1 in found[UNIT]:
            ends = [1, max(found[UNIT])]
            one = statistics.median(found[UNIT][1])
            axes.plot(ends, [one * n for n in ends], color="#aaa", linewidth=0.8, linestyle="--", label="in proportion")
        axes.set_xscale("log", base=2)
        if size == "worlds":
            axes.xaxis.set_major_locator(LogLocator(base=8, numticks=10))
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:,.0f}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.set_xlabel("cores" if size == "threads" else "worlds")
        axes.set_ylabel("env steps per second")
        axes.set_title(task, loc="left")
        axes.legend(frameon=False, fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    finish_axes(panels)
    return made


EXPERIMENT = Experiment(
    name="scaling",
    summary="Sampling by cores, and by worlds on a GPU.",
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
