"""Measure the cost of worlds that hold different objects, beside worlds that all hold one object.

    lyceum-warp bench objects --device cuda
    lyceum-warp bench objects --engines mujoco --worlds 256
    lyceum-warp bench objects --short
    lyceum-warp bench objects --policy lyceum_warp/pretrained/leap_objects --engines mujoco --worlds 16

A paddle stirs a mesh of MyoSuite (extra "menagerie") in a tray. Each mesh collides as its convex hull. The environment
with one object and the environment with many take turns of ten steps with the same random actions. An object that
leaves the tray starts a new episode.

With --policy, the policies of runs whose task turns an object in a hand act with all of the task's objects instead.
"""

import dataclasses
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import contestants
import experiment
import gate
import kept
import object_policies
from experiment import Experiment, Row, Table, choose
from object_policies import PolicyCase
from stirring import Stir, StirRedrawn

import lyceum_warp as lw
from lyceum_warp.tasks.hands.gates import STEPS

ENGINES = ("mujoco", "warp")
CONTESTANTS = {"48 objects": Stir, "48 objects, redrawn at resets": StirRedrawn}


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    engines: tuple[str, ...] = ()
    """Engines, by default warp on a GPU and both on the CPU."""
    worlds: tuple[int, ...] = (256,)
    """Numbers of worlds."""
    blocks: int = 20
    """Turns of ten steps of each environment."""
    policy: tuple[Path, ...] = ()
    """Folders of runs whose policies act with each object in 50 s, on both engines; worlds are those of each object."""
    which: str = "last"
    """Policy of each run: last, best, or the number of a saved iteration."""


@dataclasses.dataclass(frozen=True)
class Case:
    engine: str
    worlds: int
    contestant: str
    device: str
    blocks: int


def cases(options: Options) -> list[Case | PolicyCase]:
    if options.policy:
        numbers, steps = ((2,), 20) if options.short else (options.worlds, STEPS)
        devices = {"mujoco": "cpu", "warp": options.device}
        return [
            PolicyCase(folder.name, gate.digest(folder, options.which), engine, devices[engine], number, steps, seed)
            for engine in choose(options.engines, ENGINES, what="engine")
            for folder in options.policy for number in numbers for seed in options.seeds or (1,)
        ]  # fmt: skip
    usual = ENGINES if options.device == "cpu" else ENGINES[1:]
    worlds, blocks = ((8,), 1) if options.short else (options.worlds, options.blocks)
    return [
        Case(engine, number, contestant, options.device, blocks)
        for engine in choose(options.engines, ENGINES, usual, what="engine")
        for number in worlds
        for contestant in choose(options.contestants, tuple(CONTESTANTS), what="contestant")
    ]


def estimate(case: Case | PolicyCase) -> float:
    if isinstance(case, PolicyCase):
        return 10.0 * case.worlds
    return 60.0 + case.blocks * case.worlds / 256


def measure(case: Case | PolicyCase, options: Options) -> dict[str, Any]:
    if isinstance(case, PolicyCase):
        folder = next(folder for folder in options.policy if gate.digest(folder, options.which) == case.policy)
        return object_policies.measure(case, folder, options.which)
    envs = {}
    for name, task, objects in (("one", Stir, ["apple"]), ("many", CONTESTANTS[case.contestant], None)):
        lw.make(task, engine=case.engine, device=case.device, objects=objects)  # compile kernels
        envs[name] = lw.make(task, nworld=case.worlds, engine=case.engine, device=case.device, objects=objects, seed=1)
    actions = contestants.actions(envs["one"], seed=0)

    def block(env: lw.Env) -> None:
        for t in range(kept.BLOCK):
            env.action.copy_(actions[t])
            env.step()

    seconds: dict[str, list[float]] = {name: [] for name in envs}
    for repetition in range(2 + case.blocks):
        for name, env in envs.items():
            duration = kept.seconds(env, lambda env=env: block(env))
            if repetition >= 2:
                seconds[name].append(duration / kept.BLOCK)
    steps = case.worlds * kept.BLOCK * (2 + case.blocks)
    return {
        "steps_per_second": {name: case.worlds / statistics.median(each) for name, each in seconds.items()},
        "ratio": statistics.median(a / b for a, b in zip(seconds["one"], seconds["many"], strict=True)),
        "bytes_per_world": {name: env.bytes_per_world for name, env in envs.items()},
        "state_size": {name: env.state_space.size for name, env in envs.items()},
        "faults_per_million": 1e6 * sum(envs["many"].fault_counts.values()) / steps,
    }


def tables(rows: Sequence[Row]) -> list[Table]:
    header = ["engine", "worlds", "", "steps/s", "of one object's", "kB a world", "with one", "faults per million"]
    lines = [
        [row.case["engine"], f"{row.case['worlds']:,}", row.case["contestant"],
         f"{row.result['steps_per_second']['many']:,.0f}", f"{row.result['ratio']:.1%}",
         *(f"{row.result['bytes_per_world'][name] / 1e3:,.0f}" for name in ("many", "one")),
         f"{row.result['faults_per_million']:.1f}"]
        for row in rows if "policy" not in row.case
    ]  # fmt: skip
    title = "Steps of worlds with 48 meshes, beside worlds that all hold one of them; random actions."
    return [Table(title, header, lines)] * bool(lines) + object_policies.tables(rows)


EXPERIMENT = Experiment(
    name="objects",
    conditions="Memory is the estimate of the engine.",
    summary="Speed and memory of worlds that hold different objects, and policies that turn them.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
    figure=object_policies.figure,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
