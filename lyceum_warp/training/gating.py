"""End a run when its policy passes the gate of its task.

Policies are tested on CPU cores by subprocesses, ``python -m lyceum_warp.training.gating FOLDER THREADS``, while
training continues. They read iteration numbers and seeds, and write a verdict for each in one line of JSON.
"""

import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from lyceum_warp.algos import Iteration, Learner, gate
from lyceum_warp.engines import options_on_cores
from lyceum_warp.env import Curriculum
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.validate import whole_number
from lyceum_warp.training.callbacks import Callback
from lyceum_warp.training.runs.checkpoints import policy_content, write_content
from lyceum_warp.training.runs.configuration import Configuration
from lyceum_warp.training.runs.folder import Run, load, load_curriculum
from lyceum_warp.training.runs.task_copy import run_env

_SEEDS = 2
"""Number of seeds with which a policy must pass."""
_PAUSE = 3.0
"""Least time between two tests for which training waits, in durations of the first."""


class _Tester:
    """A subprocess that tests policies of a run, one at a time."""

    def __init__(self, folder: Path, nthread: int) -> None:
        command = [sys.executable, "-m", "lyceum_warp.training.gating", str(folder), str(nthread)]
        # in a session of its own, because Ctrl-C must not end the test before the run
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self.busy = False

    def test(self, number: int, seed: int) -> None:
        """Start the test of a saved policy."""
        assert self._process.stdin is not None
        print(number, seed, file=self._process.stdin, flush=True)
        self.busy = True

    def verdict(self, *, wait: bool) -> dict[str, Any] | None:
        """Return the verdict of the current test, or None if it is not finished."""
        assert self._process.stdout is not None
        if not wait and not select.select([self._process.stdout], [], [], 0.0)[0]:
            return None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the subprocess that tests policies has ended with exit code {self._process.wait()}")
        self.busy = False
        verdict: dict[str, Any] = json.loads(line)
        return verdict

    def close(self) -> None:
        """End the subprocess."""
        self._process.kill()
        self._process.communicate()


class PassGate(Callback):
    """Ends training when the policy passes the gate of its task with two seeds.

    Subprocesses test the newest policy while training continues, so that training ends some iterations after the policy
    that passes. That policy is kept in a numbered file of the run's folder. Every verdict is a line of ``gate.jsonl``,
    with the seconds that the test took. Each test uses a new seed. On four cores or more, both seeds are tested at the
    same time. On fewer, the second seed is only tested if the policy passes with the first. If training also needs
    these few cores, it waits for the tests, and then continues for at least three times as long as they took.

    Args:
        every: Iterations between policies to test. While a test or the pause after it lasts, the next ones are left
            out.

    Raises:
        ValueError: ``every`` is not a positive number, the task has no gate, or its code is not a file of its own.
    """

    def __init__(self, every: int = 20) -> None:
        self.every = whole_number("every", every, low=1)
        self.settings = {"gate_every": self.every}
        self._testers: list[_Tester] = []

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Start the subprocesses, which get ready while the first iterations run."""
        if learner.env.task.definition.gate is None:
            raise ValueError(f"the task {learner.env.task.name!r} has no gate: set its attribute gate to a lw.Gate")
        if run.config["task"] is None or run.manifest.get("program"):
            raise ValueError(
                "lw.PassGate tests policies in another process, which can't execute a notebook or the training script: "
                f"define the task {learner.env.task.name!r} in a file of its own"
            )
        self._run, self._learner, self._last = run, learner, iterations
        self._file = run.folder / "gate.jsonl"
        self._tries = len(self._file.read_text().splitlines()) if self._file.exists() else 0
        self._tested: int | None = None
        cores = cpu_cores()
        count = _SEEDS if cores >= 4 else 1
        self._waits, self._due = count == 1 and learner.env.device.is_cpu, 0.0
        free = cores if self._waits else max(1, (cores - 1) // count)
        self._testers = [_Tester(run.folder, free) for _ in range(count)]

    def __call__(self, iteration: Iteration) -> bool:
        """Read verdicts if there are some, and test the next policy if none is being tested."""
        if self._tested is not None and self._passed(wait=False):
            return True
        began = time.perf_counter()
        if self._tested is None and iteration.iteration % self.every == 0 and began >= self._due:
            self._test(iteration.iteration)
        if self._tested is None or not (self._waits or iteration.iteration >= self._last):
            return False
        passed = self._passed(wait=True)
        ended = time.perf_counter()
        self._due = ended + _PAUSE * (ended - began)
        return passed

    def _test(self, number: int) -> None:
        learner, path = self._learner, self._run.numbered(number)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            write_content(path, policy_content(number, learner.policy, None, Curriculum.of(learner.env)))
            self._temporary: Path | None = path
        else:
            self._temporary = None
        self._tested, self._good, self._left = number, 0, _SEEDS
        self._start_tests()

    def _start_tests(self) -> None:
        assert self._tested is not None
        for tester in self._testers:
            if self._left and not tester.busy:
                tester.test(self._tested, self._tries)
                self._tries += 1
                self._left -= 1

    def _passed(self, *, wait: bool) -> bool:
        """Read verdicts of the tested policy, and return whether it has passed with all seeds."""
        while busy := [tester for tester in self._testers if tester.busy]:
            verdicts = [verdict for tester in busy if (verdict := tester.verdict(wait=wait)) is not None]
            with self._file.open("a") as file:
                for verdict in verdicts:
                    print(json.dumps({"iteration": self._tested, **verdict}), file=file)
                    self._good += verdict["passed"]
                    self._left = self._left if verdict["passed"] else 0
            self._start_tests()
            if not verdicts:
                return False
        passed = self._good == _SEEDS
        if passed:
            self._run.amend(passed={"iteration": self._tested, "tries": self._tries})
        elif self._temporary is not None:
            self._temporary.unlink(missing_ok=True)
        self._tested = None
        return passed

    def close(self) -> None:
        """End the subprocesses."""
        for tester in self._testers:
            tester.close()
        if self._testers and self._tested is not None and self._temporary is not None:
            self._temporary.unlink(missing_ok=True)


def serve(folder: Path, nthread: int) -> None:
    """Read lines "iteration seed", and write the verdicts of the policies."""
    verdicts_out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # messages of libraries go to stderr
    run = Run.open(folder)
    saved = Configuration.of(run)
    options = saved.options.changed({**options_on_cores(), "nworld": 1, "physics": "exact"})
    env = run_env(run, options, saved.params, trust=True)
    torch.set_num_threads(1)  # more threads would take longer to wake up than to compute
    for line in sys.stdin:
        number, seed = map(int, line.split())
        policy, curriculum = load(run, which=number), load_curriculum(run, which=number)
        start = time.perf_counter()
        verdict = gate(env, policy, seed=seed, curriculum=curriculum, nthread=nthread, quick=True)
        result = {**verdict.to_dict(), "seconds": time.perf_counter() - start, "unix_time": time.time()}
        print(json.dumps(result), file=verdicts_out, flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]))
