"""Test whether NPG learns equally well on both engines.

    lyceum-warp bench equivalence --device cuda

The area under a learning curve is the run's mean return over all iterations. Two one-sided t tests (TOST) at the level
0.05 compare the areas of the two engines, with 20 seeds each. The margin, one standard deviation between seeds, was
chosen before the first run.
"""

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import numpy as np
import torch
from experiment import Experiment, Row, Skipped, Table, choose

import lyceum_warp as lw
from lyceum_warp.engines.placement import find_device
from lyceum_warp.support.intervals import student_quantile

SAMPLES = {"inverted_double_pendulum": 100_000, "hopper": 200_000, "half_cheetah": 200_000}

ENGINES = {"mujoco": "C engine", "warp": "Warp engine"}
SEEDS, NWORLD, PER_ITERATION = 20, 10, 10_000


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    engine: str
    seed: int
    nworld: int
    samples: int
    per_iteration: int
    device: str


def cases(options: experiment.Options) -> list[Case]:
    short = options.short
    engines = choose(options.contestants, ENGINES, what="contestant")
    return [
        Case(task, engine, seed, NWORLD, 2000 if short else SAMPLES[task], 1000 if short else PER_ITERATION,
             options.device if engine == "warp" else "cpu")
        for seed in options.seeds or range(2 if short else SEEDS)
        for task in choose(options.tasks, SAMPLES, ("inverted_double_pendulum",) if short else (), what="task")
        for engine in engines
    ]  # fmt: skip


def estimate(case: Case) -> float:
    rate = 1500.0 if case.engine == "warp" and case.device == "cpu" else 10_000.0
    return 3.0 + case.samples / rate


def measure(case: Case, options: experiment.Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    try:
        find_device(case.device)
    except ValueError as error:
        raise Skipped(str(error)) from error
    threads = {"nthread": options.threads} if case.engine == "mujoco" else {}
    env = lw.make(case.task, nworld=case.nworld, engine=case.engine, device=case.device, seed=case.seed, **threads)
    learner = lw.NPG(env, config=lw.NPGConfig(samples=case.per_iteration, mean_every=0), seed=case.seed)
    curve = []
    while learner.samples < case.samples:
        it = next(learner)
        assert it.return_mean is not None
        curve.append([it.samples, it.return_mean])
    returns = [value for _, value in curve if math.isfinite(value)]  # a return is NaN if no episode ended
    return {"area": sum(returns) / len(returns), "curve": [[n, v if math.isfinite(v) else None] for n, v in curve]}


def equivalence(a: np.ndarray, b: np.ndarray) -> dict[str, Any]:
    """Test whether Welch's 90 % interval of the difference between the means (b minus a) lies within the margin."""
    parts = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    spread = sum(parts)
    freedom = spread**2 / (parts[0] ** 2 / (len(a) - 1) + parts[1] ** 2 / (len(b) - 1)) if spread else 1.0
    half = student_quantile(0.95, freedom) * math.sqrt(spread)
    squares = (len(a) - 1) * a.var(ddof=1) + (len(b) - 1) * b.var(ddof=1)
    margin, difference = math.sqrt(squares / (len(a) + len(b) - 2)), float(b.mean() - a.mean())
    verdict = "not shown"
    if abs(difference) + half <= margin:
        verdict = "equivalent"
    elif abs(difference) - half > margin:
        verdict = "different"
    return {"difference": difference, "half": half, "margin": margin, "verdict": verdict}


def tables(rows: Sequence[Row]) -> list[Table]:
    lines = []
    groups: dict[tuple[str, int, str], dict[str, list[float]]] = {}
    devices = {row.case["device"] for row in rows if row.case["engine"] == "warp"}
    for row in rows:
        case = row.case
        for device in devices if case["engine"] == "mujoco" else {case["device"]}:
            areas = groups.setdefault((case["task"], case["samples"], device), {name: [] for name in ENGINES})
            areas[case["engine"]].append(row.result["area"])
    for (task, samples, device), areas in groups.items():
        a, b = np.array(areas["mujoco"]), np.array(areas["warp"])
        if min(len(a), len(b)) < 2:
            continue
        test = equivalence(a, b)
        verdict = test["verdict"] if test["margin"] < abs(a.mean()) else "margin exceeds the mean"
        lines.append([
            task, f"{samples:,}", device, f"{len(a)}, {len(b)}", f"{a.mean():.5g} ± {a.std(ddof=1):.3g}",
            f"{b.mean():.5g} ± {b.std(ddof=1):.3g}", f"{test['difference']:+.3g} ± {test['half']:.3g}",
            f"{test['margin']:.3g}", verdict,
        ])  # fmt: skip
    title = (
        "Area under NPG's learning curves on both engines, mean and standard deviation over seeds; the difference with "
        "its 90 % interval, and the margin, one pooled standard deviation between seeds (two one-sided tests at 5 %). "
        "A margin that exceeds the mean permits no verdict."
    )
    header = ["task", "samples", "Warp on", "seeds", *ENGINES.values(), "difference", "margin", "verdict"]
    return [Table(title, header, lines)]


EXPERIMENT = Experiment(
    name="equivalence", conditions="Both engines step tasks with exact physics.",
    summary="Equivalence of NPG's learning curves on the two engines (TOST).",
    cases=cases, estimate=estimate, measure=measure, tables=tables, parallel=True, pooled=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
