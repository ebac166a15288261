"""Test whether a run's policy passes the gate of its task: lyceum-warp gate."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp import algos, engines, training
from lyceum_warp.cli.display import console, say, say_entries, table
from lyceum_warp.cli.evaluate import open_run, run_worlds
from lyceum_warp.support.long_work import LongWork


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gate:
    """Test whether a run's mean policy passes the gate of its task, such as whether a robot walks.

    The test runs on the C engine under the task's exact physics, whatever the run has used. The exit code is 1 if the
    policy does not pass.

    $ lyceum-warp gate runs/go1_velocity-20260101-120000
    $ lyceum-warp gate g1_velocity --pretrained --seed 1
    """

    USUAL = ("folder", "which", "pretrained", "seed", "task")

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN|TASK")]
    """A run's folder; with --pretrained, the name of a task."""
    which: str = "last"
    """The policy: last, best, or the number of a saved iteration."""
    pretrained: bool = False
    """Whether to test the package's pretrained policy of the task."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """Another task, whose gate is used. The run's parameters are not applied to it."""
    seed: int = 0
    """Seed of the worlds."""
    nthread: int | None = None
    """Threads of the C engine; by default all cores."""

    def run(self) -> int:
        run = open_run(self.folder, pretrained=self.pretrained)
        env = run_worlds(run, {**engines.options_on_cores(), "physics": "exact"}, {}, nworld=1, task=self.task)
        policy = training.load(run, which=self.which)
        curriculum = None if self.task else training.load_curriculum(run, which=self.which)
        with LongWork("testing the policy", "parts", console):
            verdict = algos.gate(env, policy, seed=self.seed, curriculum=curriculum, nthread=self.nthread)
        limits = [(limit, verdict.numbers[name]) for name, limit in verdict.limits.items()]
        columns = {
            "": [limit.text for limit, _ in limits],
            "measured": [f"{number:.3g}" for _, number in limits],
            "limit": [limit.range for limit, _ in limits],
            "verdict": [("pass" if limit.allows(x) else "FAIL") if limit.range else "" for limit, x in limits],
        }
        console.print(table(columns))
        start = f", begun at {verdict.memory}" if verdict.memory else ""
        say(f"{verdict.task}: the policy {'passes' if verdict.passed else 'does not pass'} on the C engine under exact "
            f"physics{start}")  # fmt: skip
        place = f"{self.folder} --pretrained" if self.pretrained else f"{self.folder} --which {self.which}"
        export = f", or lyceum-warp export {place}" if verdict.passed else ""
        say_entries(next=f"lyceum-warp view {place}{export}")
        return 0 if verdict.passed else 1
