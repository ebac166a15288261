"""End a run when its policy passes the gate of its task.

Policies are tested on CPU cores by a subprocess, ``python -m lyceum_warp.training.gating FOLDER``, while training
continues. It reads iteration numbers and seeds, and writes a verdict for each in one line of JSON.
"""

import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any

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


class PassGate(Callback):
    """Ends training when the policy passes the gate of its task with two seeds, one after the other.

    A subprocess tests the newest policy while training continues, so that training ends some iterations after the
    policy that passes. That policy is kept in a numbered file of the run's folder. Every verdict is a line of
    ``gate.jsonl``, with the seconds that the test took. Each test uses new seeds.

    Args:
        every: Iterations between policies to test. While a test lasts, the next ones are left out.

    Raises:
        ValueError: ``every`` is not a positive number, the task has no gate, or its code is not a file of its own.
    """

    def __init__(self, every: int = 20) -> None:
        self.every = whole_number("every", every, low=1)
        self.settings = {"gate_every": self.every}
        self._process: subprocess.Popen[str] | None = None

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Start the subprocess, which gets ready while the first iterations run."""
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
        words = [sys.executable, "-m", "lyceum_warp.training.gating", str(run.folder)]
        # in a session of its own, because Ctrl-C must not end the test before the run
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    def __call__(self, iteration: Iteration) -> bool:
        """Read the verdict if there is one, and test the next policy if none is being tested."""
        if self._tested is not None and self._verdict(wait=False):
            return True
        if self._tested is None and iteration.iteration % self.every == 0:
            self._test(iteration.iteration)
        return self._tested is not None and iteration.iteration >= self._last and self._verdict(wait=True)

    def _test(self, number: int) -> None:
        learner, path = self._learner, self._run.numbered(number)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            write_content(path, policy_content(number, learner.policy, None, Curriculum.of(learner.env)))
            self._temporary: Path | None = path
        else:
            self._temporary = None
        assert self._process is not None and self._process.stdin is not None
        print(number, self._tries, file=self._process.stdin, flush=True)
        self._tested = number

    def _verdict(self, *, wait: bool) -> bool:
        """Return whether the tested policy has passed with both seeds."""
        assert self._process is not None and self._process.stdout is not None
        pipe: IO[str] = self._process.stdout
        if not wait and not select.select([pipe], [], [], 0.0)[0]:
            return False
        line = pipe.readline()
        if not line:
            raise RuntimeError(f"the subprocess that tests policies has ended with exit code {self._process.wait()}")
        verdicts: list[dict[str, Any]] = json.loads(line)
        with self._file.open("a") as file:
            for verdict in verdicts:
                print(json.dumps({"iteration": self._tested, **verdict}), file=file)
        self._tries += len(verdicts)
        passed = len(verdicts) == 2 and all(verdict["passed"] for verdict in verdicts)
        if passed:
            self._run.amend(passed={"iteration": self._tested, "tries": self._tries})
        elif self._temporary is not None:
            self._temporary.unlink(missing_ok=True)
        self._tested = None
        return passed

    def close(self) -> None:
        """End the subprocess."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            if self._tested is not None and self._temporary is not None:
                self._temporary.unlink(missing_ok=True)


def serve(folder: Path) -> None:
    """Read lines "iteration seed", and write the verdicts of the policies: two if the first is good."""
    verdicts_out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # messages of libraries go to stderr
    run = Run.open(folder)
    saved = Configuration.of(run)
    options = saved.options.changed({**options_on_cores(), "nworld": 1, "physics": "exact"})
    env = run_env(run, options, saved.params, trust=True)
    nthread = max(1, cpu_cores() - 1)
    for line in sys.stdin:
        number, seed = map(int, line.split())
        policy, curriculum = load(run, which=number), load_curriculum(run, which=number)
        verdicts: list[dict[str, Any]] = []
        while len(verdicts) < 2 and all(verdict["passed"] for verdict in verdicts):
            start = time.perf_counter()
            verdict = gate(env, policy, seed=seed, curriculum=curriculum, nthread=nthread, quick=True)
            seconds = time.perf_counter() - start
            verdicts.append({**verdict.to_dict(), "seconds": seconds, "unix_time": time.time()})
            seed += 1
        print(json.dumps(verdicts), file=verdicts_out, flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
