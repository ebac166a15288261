"""Measure what memory is worth: students of a Go1, PPO with hidden velocities, and a policy cloned from episodes.

    lyceum-warp bench students --parts go1 --device cuda --seeds 42
    lyceum-warp bench students --parts hidden clone

Part "go1": a student of the pretrained Go1 does not see its linear velocity. Students with and without a GRU learn from
the teacher, and the gate of the task tests both and the teacher, on the C engine under exact physics. Part "hidden":
PPO learns to balance a double pendulum by positions only. Part "clone": a student learns from saved episodes of the
pretrained hopper.
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Sequence
from typing import Any

import experiment
import numpy as np
import torch
from experiment import Experiment, Row, Table, choose
from hidden_pendulum import HiddenPendulum

import lyceum_warp as lw
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.engines import options_on_cores
from lyceum_warp.support.intervals import mean_interval

PARTS = ("go1", "hidden", "clone")
GATE_SEED = 1000


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """go1, hidden and clone; by default all."""
    iterations: int | None = None
    """Iterations of each learner; by default 150 of a Go1's student, 200 of PPO and of a clone."""
    nworld: int | None = None
    """Number of worlds; by default 4096 for a Go1 on a GPU, 128 on the CPU, and 64 for the other parts."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    contestant: str
    """The units of the GRU, as in "GRU 256", "no memory", or "teacher"."""
    seed: int
    iterations: int
    nworld: int
    device: str


def cases(options: Options) -> list[Case]:
    parts = choose(options.parts, PARTS, what="part")
    worlds = {"go1": 4096 if options.device.startswith("cuda") else 128, "hidden": 64, "clone": 64}
    iterations = dict.fromkeys(PARTS, 2) if options.short else {"go1": 150, "hidden": 200, "clone": 200}
    kinds = {"go1": ("teacher", "GRU 256", "no memory"), "hidden": ("GRU 64", "no memory"), "clone": ("no memory",)}
    return [
        Case(part, kind, seed, options.iterations or iterations[part], options.nworld or worlds[part], options.device)
        for part in parts for seed in options.seeds or ((42,) if options.short else (42, 43, 44))
        for kind in kinds[part] if kind in options.contestants or not options.contestants
    ]  # fmt: skip


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    return {"go1": student, "hidden": hidden, "clone": clone}[case.part](case, options.short)


def learned(learner: lw.Learner, case: Case) -> dict[str, Any]:
    """Run a learner's iterations, and return the seconds and the number of samples.

    The seconds are those of the wall clock on a GPU. On the CPU, they are those of the process, because other processes
    may share the cores.
    """
    clock = time.perf_counter if case.device.startswith("cuda") else time.process_time
    began = clock()
    while learner.iteration < case.iterations:
        next(learner)
    return {"seconds": round(clock() - began, 1), "samples": learner.samples}


def units(case: Case) -> int:
    return int(case.contestant.partition(" ")[2]) if case.contestant.startswith("GRU") else 0


def student(case: Case, short: bool) -> dict[str, Any]:
    teacher = lw.load(lw.pretrained_run("go1_velocity"))
    result: dict[str, Any] = {"seconds": 0.0, "samples": 0}
    task = "go1_velocity"
    policy: Any = teacher
    if case.contestant != "teacher":
        task = "go1_student_velocity"
        env = lw.make(task, nworld=case.nworld, device=case.device, seed=case.seed, physics="coarse")
        config = lw.DistillConfig(recurrent=units(case), mean_every=0)
        learner = lw.Distill(env, config=config, teacher=teacher, seed=case.seed)
        result = learned(learner, case)
        policy = learner.policy.to("cpu")
    verdict = lw.gate(lw.make(task, **options_on_cores()), policy, seed=GATE_SEED + case.seed, quick=short)
    return result | {"passed": verdict.passed, "numbers": dict(verdict.numbers)}


def hidden(case: Case, short: bool) -> dict[str, Any]:
    env = lw.make(HiddenPendulum, nworld=case.nworld, device=case.device, seed=case.seed)
    config = lw.PPOConfig(
        hidden=(64,), value_hidden=(64,), recurrent=units(case), entropy_coef=0.003, log_std=-0.5, mean_every=0
    )
    learner = lw.PPO(env, config=config, seed=case.seed)
    result = learned(learner, case)
    return result | {"returns": returns_of(HiddenPendulum, learner.policy, 4 if short else 32)}


@functools.cache
def demonstrations(count: int) -> tuple[lw.Demonstrations, list[float]]:
    env = lw.make("hopper", nworld=count, autoreset=False)
    episodes = list(policy_episodes(env, lw.load(lw.pretrained_run("hopper")), count, seed=1))
    return lw.Demonstrations(episodes), [round(episode.episode_return, 2) for episode in episodes]


def clone(case: Case, short: bool) -> dict[str, Any]:
    teacher, teacher_returns = demonstrations(4 if short else 50)
    env = lw.make("hopper", nworld=case.nworld, device=case.device, seed=case.seed)
    config = lw.DistillConfig(hidden=(64, 64), mean_every=0)
    learner = lw.Distill(env, config=config, teacher=teacher, seed=case.seed)
    result = learned(learner, case)
    returns = returns_of("hopper", learner.policy, 4 if short else 50)
    return result | {"returns": returns, "teacher_returns": teacher_returns}


def returns_of(task: Any, policy: torch.nn.Module, episodes: int) -> list[float]:
    env = lw.make(task, nworld=episodes, **options_on_cores())
    return [round(value, 2) for value in lw.evaluate(env, policy, episodes, seed=2).returns.tolist()]


def tables(rows: Sequence[Row]) -> list[Table]:
    sections = []
    for part, title, header in (
        ("go1", "A Go1 without its linear velocity, taught by the pretrained Go1: the gate of the task.",
         ["student", "seed", "worlds", "iterations", "s", "gate", "falls", "velocity error, m/s", "with pushes"]),
        ("hidden", "PPO on the inverted double pendulum by positions only: returns of 32 episodes.",
         ["policy", "seed", "worlds", "iterations", "s", "return"]),
        ("clone", "A policy cloned from 50 episodes of the pretrained hopper: returns of 50 new episodes.",
         ["student", "seed", "worlds", "iterations", "s", "return", "teacher's", "share"]),
    ):  # fmt: skip
        lines = []
        for row in (row for row in rows if row.case["part"] == part):
            case, result = row.case, row.result
            trained = [str(case["nworld"]), str(case["iterations"]), f"{result['seconds']:.0f}"]
            start = [case["contestant"], str(case["seed"]), *(trained if result["samples"] else 3 * [""])]
            lines.append([*start, *values(result)])
        if lines:
            sections.append(Table(title, header, lines))
    return sections


def values(result: dict[str, Any]) -> list[str]:
    if "numbers" in result:
        numbers = result["numbers"]
        errors = [f"{numbers.get(name, np.nan):.3f}" for name in ("velocity_error", "pushed_velocity_error")]
        return ["passes" if result["passed"] else "does not pass", str(numbers["falls"]), *errors]
    mean, half = mean_interval(np.array(result["returns"]))
    text = f"{mean:,.0f} ± {half:.0f}"
    if "teacher_returns" not in result:
        return [text]
    other, other_half = mean_interval(np.array(result["teacher_returns"]))
    share, spread = mean / other, np.hypot(half / other, mean * other_half / other**2)
    return [text, f"{other:,.0f} ± {other_half:.0f}", f"{share:.1%} ± {spread:.1%}"]


EXPERIMENT = Experiment(
    name="students", conditions="Policies are tested on the C engine under exact physics.",
    summary="Students and policies with memory: a Go1, a pendulum with hidden velocities, and a cloned hopper.",
    cases=cases, estimate=lambda case: 300.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
