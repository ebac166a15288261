"""Measure environment steps per second of lyceum_warp, native C and other libraries (the paper's figure 1).

    lyceum-warp bench throughput --short
    lyceum-warp bench throughput --parts worlds kept --device cuda

The part ``sampling`` runs many worlds on all threads; the reference is native C (``mujoco.rollout``). ``suite`` runs
dm_control's tasks with equal numbers of worlds; the reference is dm_control. ``single`` runs one world on one thread;
the reference is Gymnasium. ``cores`` runs the part ``sampling`` on 1, 2, 4, ... cores. ``worlds`` measures lyceum_warp
with 1 to 131,072 worlds. ``training`` compares exact physics with the physics that a task suggests for training.
``kept`` compares an environment with its bare engine (kept.py).
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from typing import Any

import contestants
import experiment
import kept
from contestants import LABELS
from experiment import Experiment, Row, Table, choose, median_and_range

import lyceum_warp as lw
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.viz import STYLES, finish_axes, new_figure

TASKS = (
    "cartpole", "hopper", "walker2d", "half_cheetah", "swimmer", "ant", "humanoid", "herb_reach", "humanoid_standup",
    "pusher", "reacher", "inverted_pendulum", "inverted_double_pendulum",
)  # fmt: skip
SHORT_TASKS = ("half_cheetah", "humanoid")
SUITE = (
    "dm/cartpole_swingup", "dm/cheetah_run", "dm/walker_walk", "dm/quadruped_walk", "dm/humanoid_walk",
)  # fmt: skip
SUITE_WORLDS = (2, 16, 128)
SCALED = ("humanoid",)
PARTS = {
    "sampling": ("native", "c", "warp", "envpool", "gym-async", "gym-sync"),
    "suite": ("dm_control", "c", "envpool"),
    "single": ("gymnasium", "c", "envpool"),
    "cores": ("native", "c", "envpool", "gym-async"),
    "worlds": ("warp", "c"),
    "training": ("c", "c-suggested", "warp", "warp-suggested"),
    "kept": ("c", "warp"),
}
"""Contestants of each part. By default, the Warp engine runs only on a GPU."""
VELOCITY = tuple(name for name in lw.task_names() if name.endswith("_velocity"))
UNITS = {"sampling": "native", "suite": "dm_control", "single": "gymnasium", "cores": "native"}
WORLDS = {"warp": (1, 8, 64, 512, 2_048, 8_192, 16_384, 32_768, 65_536, 131_072), "c": (1, 8, 64, 512, 4_096)}
CPU_WORLDS = 512


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """Parts: sampling, suite, single, cores, worlds, training, kept; by default all."""
    seconds: float = 1.0
    """Duration of each measurement in seconds."""
    worlds: int | None = None
    """Number of worlds of lyceum_warp and of native C; by default 64 per thread, and 16,384 on a GPU. In the part
    "suite", number of worlds of every contestant; by default 2, 16 and 128."""
    policy: str | None = None
    """Folder of a run whose policy chooses the actions in the part "kept". By default, actions are random."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    task: str
    repeat: int
    """Index of the repeat, which is also the seed of actions and initial states."""
    contestant: str
    worlds: int
    threads: int
    device: str
    seconds: float
    warm: int
    policy: str | None = None


def cases(options: Options) -> list[Case]:
    everything = dict.fromkeys(name for names in PARTS.values() for name in names)
    named = choose(options.contestants, everything, what="contestant")
    choices = (*TASKS, *sorted({*lw.task_names()} - {*TASKS}))
    tasks = choose(options.tasks, choices, SHORT_TASKS if options.short else TASKS, what="task")
    usual = {"cores": SCALED, "worlds": SCALED, "training": VELOCITY, "suite": SUITE[:1] if options.short else SUITE}
    threads, gpu = options.threads or cpu_cores(), options.device.startswith("cuda")
    repeats = options.repeats or (1 if options.short else 3)
    seconds, warm = (0.2, 20) if options.short else (options.seconds, 100)

    def size(part: str, name: str, cores: int) -> int:
        requested = options.worlds if name.startswith(("native", "c", "warp")) else None
        if part == "training" and gpu:
            requested = requested or 4096
        return 1 if part == "single" else requested or contestants.worlds(name, cores, options.device)

    def sizes(part: str, name: str) -> list[tuple[int, int]]:
        if part == "cores":
            doubled = [1 << k for k in range(threads.bit_length()) if 1 << k < threads]
            return [(size(part, name, cores), cores) for cores in (*doubled, threads)]
        if part == "suite":
            many = (options.worlds,) if options.worlds else SUITE_WORLDS[:1] if options.short else SUITE_WORLDS
            return [(number, threads) for number in many]
        if part == "worlds" and not options.worlds:
            most = 64 if options.short else CPU_WORLDS if name == "warp" and not gpu else max(WORLDS[name])
            return [(many, threads) for many in WORLDS[name] if many <= most]
        return [(size(part, name, threads), 1 if part == "single" else threads)]

    return [
        Case(part, task, repeat, name, worlds, cores, options.device if name.startswith("warp") else "cpu", seconds,
             0 if part == "kept" else warm if worlds <= contestants.GPU_WORLDS else 20,
             options.policy if part == "kept" else None)
        for part in choose(options.parts, PARTS, what="part")
        for task in (tasks if options.tasks else usual.get(part, tasks))
        for repeat in range(1 if part == "kept" else repeats)
        for name in PARTS[part]
        if name in named and (name.startswith("warp") == gpu if part == "training" else
                              name != "warp" or gpu or options.contestants)
        and (part == "kept" or (task.startswith("dm/") if part == "suite" else
                                task in VELOCITY if part == "training" else task in TASKS))
        and (part == "kept" or contestants.takes_part(name, task))
        for worlds, cores in sizes(part, name)
    ]  # fmt: skip


def estimate(case: Case) -> float:
    if case.part == "kept":
        return 15.0 * case.seconds
    return 3.0 + case.seconds * (4.0 if case.contestant == "native" else 2.0)


def measure(case: Case, options: Options) -> dict[str, Any]:
    if case.part == "kept":
        place = {"engine": "warp", "device": case.device} if case.contestant == "warp" else {
            "engine": "mujoco", "nthread": case.threads}  # fmt: skip
        with experiment.cores(case.threads):
            return kept.measure(case.task, case.worlds, max(5, int(30 * case.seconds)), case.policy, **place)
    return contestants.measure(
        case.contestant, case.task, worlds=case.worlds, threads=case.threads, device=case.device, seed=case.repeat,
        seconds=case.seconds, warm=case.warm,
    )  # fmt: skip


# tables and figure


def grouped(rows: Sequence[Row], part: str, *by: str) -> dict[tuple[Any, ...], list[Row]]:
    order = {task: place for place, task in enumerate(TASKS)}
    mine = [row for row in rows if row.case["part"] == part]
    mine.sort(key=lambda row: (order.get(row.case["task"], len(order)), row.case["task"], row.case["threads"],
                               row.case["worlds"]))  # fmt: skip
    return experiment.grouped(mine, *by)


def rates(rows: Sequence[Row], contestant: str) -> list[float]:
    return [row.result["env_steps_per_second"] for row in rows if row.case["contestant"] == contestant]


def contestants_of(part: str) -> tuple[str, ...]:
    """Return the contestants of a part, and those of its earlier stored results."""
    return tuple(dict.fromkeys((*PARTS[part], *LABELS)))


def peers(rows: Sequence[Row]) -> str:
    peer_versions = {row.result.get("versions") for row in rows if row.case["part"] == "suite"} - {None}
    return f" ({'; '.join(sorted(peer_versions))})" * bool(peer_versions)


def tables(rows: Sequence[Row]) -> list[Table]:
    tables = []
    for part, by, title in (
        ("sampling", ("task",), "Environment steps per second, and their ratio to native C's."),
        ("suite", ("task", "worlds"), f"dm_control's suite{peers(rows)}: steps/s, and their ratio to dm_control's."),
        ("single", ("task",), "One world on one thread: environment steps per second, and their ratio to Gymnasium's."),
        ("cores", ("task", "threads"), "Environment steps per second by cores, and their ratio to native C's."),
        ("worlds", ("task", "worlds"), "Environment steps per second by worlds."),
        (
            "training",
            ("task", "worlds"),
            "Environment steps per second with exact physics, and with the physics that a "
            "task suggests for training; random actions.",
        ),
    ):
        groups = grouped(rows, part, *by)
        names = [name for name in contestants_of(part) if any(rates(same, name) for same in groups.values())]
        lines = []
        for place, same in groups.items():
            ratios = experiment.paired(same, "env_steps_per_second", UNITS[part]) if part in UNITS else {}
            cells = [f"{statistics.median(values):,.0f}" if (values := rates(same, name)) else "" for name in names]
            beside = [median_and_range(ratios.get(name, [])) if name != UNITS.get(part) else "" for name in names]
            both = [f"{cell}; {ratio}" if ratio else cell for cell, ratio in zip(cells, beside, strict=True)]
            lines.append([*(f"{value:,}" if isinstance(value, int) else value for value in place), *both])
        explained = "Medians over the repeats; ratios of the same repeat: median (smallest to largest)."
        if lines:
            tables.append(Table(f"{title} {explained}", [*by, *(LABELS[name] for name in names)], lines))
    runs = grouped(rows, "kept", "task", "contestant", "worlds", "policy").values()
    if lines := [kept_line(latest) for *_, latest in runs]:
        header = ["task", "engine", "worlds", "env steps/s", "of the bare engine's", "added to a step", "kB a world"]
        tables.append(
            Table("Environment and bare engine on the same states, alternating every ten steps.", header, lines)
        )
    return tables


def kept_line(row: Row) -> list[str]:
    case, result = row.case, row.result
    step = case["worlds"] / result["env_steps_per_second"]
    memory = result["bytes_per_world"]
    task = case["task"] + (", trained policy" if case.get("policy") else "")
    return [
        task, "Warp" if case["contestant"] == "warp" else "C", f"{case['worlds']:,}",
        f"{result['env_steps_per_second']:,.0f}", f"{result['kept']:.1%}",
        f"{result['added_microseconds']:,.0f} µs of {step * 1e3:.2f} ms",
        "" if memory is None else f"{memory / 1e3:,.1f}",
    ]  # fmt: skip


def figure(rows: Sequence[Row]) -> Any:
    groups = grouped(rows, "sampling", "task")
    ratios = {task: experiment.paired(same, "env_steps_per_second", "native") for (task,), same in groups.items()}
    names = [
        name for name in contestants_of("sampling")[1:] if any(task_ratios.get(name) for task_ratios in ratios.values())
    ]
    if not names:
        return None
    figure = new_figure("throughput", 9.5, 3.9)
    axes = figure.subplots()
    for k, (name, (color, marker, _)) in enumerate(zip(names, STYLES, strict=False)):
        points = [(i, values) for i, task_ratios in enumerate(ratios.values()) if (values := task_ratios.get(name))]
        places = [i + 0.12 * (k - (len(names) - 1) / 2) for i, _ in points]
        middles = [statistics.median(values) for _, values in points]
        axes.vlines(places, [min(values) for _, values in points], [max(values) for _, values in points], color=color)
        axes.plot(places, middles, linestyle="", marker=marker, color=color, markersize=6, label=LABELS[name])
    axes.axhline(1.0, color="black", linewidth=1.0, label=LABELS["native"])
    axes.set_yscale("log")
    axes.set_yticks([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100])
    axes.minorticks_off()
    every = [1.0, *(ratio for task_ratios in ratios.values() for name in names for ratio in task_ratios.get(name, ()))]
    axes.set_ylim(0.8 * min(every), 1.25 * max(every))
    axes.yaxis.set_major_formatter("{x:g}")
    for i in range(1, len(ratios)):
        axes.axvline(i - 0.5, color="#e4e7eb", linewidth=0.8)
    axes.set_xlim(-0.5, len(ratios) - 0.5)
    axes.set_xticks(range(len(ratios)), [task.replace("_", "\n") for task in ratios], fontsize="small")
    axes.set_ylabel("environment steps per second,\nnative C = 1")
    threads = max(row.case["threads"] for row in rows if row.case["part"] == "sampling")
    axes.set_title(f"{threads} threads, log scale", loc="left", fontsize="medium")
    figure.legend(loc="outside lower center", frameon=False, ncols=4, fontsize="small")
    finish_axes([axes])
    axes.grid(visible=False, axis="x")
    return figure


EXPERIMENT = Experiment(
    name="throughput",
    conditions="lyceum_warp steps tasks with their own (exact) physics, on the engine that a table names.",
    summary="Environment steps per second, compared with native C and other libraries.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
    packages=("envpool",),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
