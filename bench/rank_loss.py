"""Measure how much return a planner with coarser physics loses, and how well it ranks samples.

    lyceum-warp bench rank_loss half_cheetah hopper

The loss of a setting is (R_exact - R_setting) / (R_exact - R_none). R_exact is the return of a planner with the task's
physics. R_setting is the return of a planner with the setting. R_none is the return without a planner. Each line of
results/rank-loss.jsonl holds these three returns, and the rank correlations that ``lyceum-warp tune --planning``
computes. The load of the machine does not matter, because episodes do not run in real time.
"""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import tyro
from experiment import RESULTS

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.support.intervals import mean_interval
from lyceum_warp.tuning.candidates import Setting
from lyceum_warp.tuning.ranking import Rankings

IMPLICIT, EULER = {"integrator": "implicitfast"}, {"integrator": "euler"}
ELLIPTIC = {"cone": "elliptic"}


def substeps(number: int, seconds: float) -> dict[str, Any]:
    return {"frame_skip": number, "timestep": seconds / number}


def iterations(limit: int) -> dict[str, Any]:
    return {"solver": {"iterations": limit}}


@dataclasses.dataclass(frozen=True)
class Study:
    plants: int
    steps: int
    settings: tuple[dict[str, Any], ...]
    words: Mapping[str, Any] = dataclasses.field(default_factory=dict)


STUDIES = {
    "reach": Study(16, 75, (substeps(1, 0.02), substeps(1, 0.02) | IMPLICIT, iterations(1), IMPLICIT)),
    "cartpole_swingup": Study(8, 200, (EULER, IMPLICIT)),
    "half_cheetah": Study(
        6, 40, (iterations(2), iterations(1), ELLIPTIC, *(substeps(n, 0.05) for n in (3, 2, 1)),
                substeps(1, 0.05) | IMPLICIT, IMPLICIT), {"samples": 32, "horizon": 20},
    ),
    "hopper": Study(6, 50, (iterations(1),), {"samples": 24, "horizon": 48}),
}  # fmt: skip


def returns(task: str, study: Study, physics: Any, *, planned: bool = True) -> np.ndarray:
    env = lw.make(task, nworld=study.plants, autoreset=False)
    env.rand_reset(1000)
    plan = lw.MPPI(task, plants=study.plants, seed=1000, physics=physics, **study.words)
    total, going = torch.zeros(study.plants, dtype=torch.float64), torch.ones(study.plants, dtype=torch.bool)
    empty = plan.actions[0].clone()
    for step in range(study.steps):
        env.step(plan(env.get_state(), shift=min(step, 1)) if planned else empty)
        total += torch.where(going, env.reward, 0.0)
        going &= ~env.done
        if not going.any():
            break
    return total.numpy()


def main(tasks: tyro.conf.Positional[tuple[str, ...]]) -> None:
    """Measure those settings of the given tasks that have no stored result yet.

    Args:
        tasks: Names of tasks.
    """
    torch.set_num_threads(1)
    path = RESULTS / "rank-loss.jsonl"
    stored = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    for task in tasks:
        study = STUDIES[task]
        known = [row for row in stored if row["task"] == task]
        left = [physics for physics in study.settings if physics not in [row["physics"] for row in known]]
        if not left:
            continue
        exact, unplanned = (
            (np.array(known[0]["exact"]), np.array(known[0]["unplanned"])) if known
            else (returns(task, study, "exact"), returns(task, study, "exact", planned=False))
        )  # fmt: skip
        ranks = Rankings(find_task(task), states=6, repeats=1, **{"samples": 64, **study.words})
        for physics in left:
            row = ranks.measure(Setting("", "", physics))
            coarse = returns(task, study, lw.PhysicsOptions(**physics))
            loss, half = mean_interval((exact - coarse) / (exact - unplanned).mean())
            found = {"task": task, "physics": physics, "ranks": row["ranks"], "loss": loss, "half": half,
                     "steps": study.steps, "exact": exact.round(4).tolist(), "coarse": coarse.round(4).tolist(),
                     "unplanned": unplanned.round(4).tolist()}  # fmt: skip
            with path.open("a") as file:
                file.write(json.dumps(found) + "\n")
            means = {kind: round(value["mean"], 3) for kind, value in row["ranks"].items()}
            print(task, physics, means, f"loss {loss:.3f} +- {half:.3f}", flush=True)


if __name__ == "__main__":
    tyro.cli(main, prog="lyceum-warp bench rank_loss")
