"""Read and write the folder of a training run."""

import contextlib
import csv
import json
import logging
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos import GaussianPolicy
from lyceum_warp.binding import class_in_file, file_name, made
from lyceum_warp.env import Curriculum
from lyceum_warp.support.files import replace_text, replaced, unknown_format
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import whole_number
from lyceum_warp.support.versions import versions
from lyceum_warp.training.runs.checkpoints import FORMAT, network_of, read_checkpoint, write_content
from lyceum_warp.training.runs.trust import is_trusted, remember

CONFIG, _TASK, _POLICIES = "config.json", "task", "policies"

NETWORK = "network"
"""The folder for the file of the user's network, in the folder ``task``."""

PRETRAINED = Path(__file__).resolve().parents[2] / "pretrained"
"""The folder of the package's pretrained runs."""

_UNFINISHED = {f"{CONFIG}.tmp", f"{_TASK}.tmp"}
"""Temporary files that remain if a process is killed while it creates a run."""

_COUNT = 0
"""The type of entries that are whole numbers of at least 0."""

_ENTRIES: dict[str, Any] = {
    "task": str | None, "params": dict, "options": dict, "physics": dict, "engine": str, "device": str,
    "algorithm": str, "nworld": _COUNT, "threads": _COUNT, "seed": _COUNT, "iterations": _COUNT, "keep_every": _COUNT,
    "save_every": _COUNT, "video_every": _COUNT, "tensorboard": bool, "target_return": float | int | None,
    "reached": {"iteration": _COUNT, "return": float | int}, "exact_from": int | None, "gate_every": _COUNT,
    "passed": {"iteration": _COUNT, "tries": _COUNT}, "versions": dict, "resumed": list, "wandb": str | None,
    "terms": {"rewards": dict, "ends": list}, "network": str, "learner": str,
    "kept": {
        "name": str, "file": str, "model": str, "model_given": bool, "source_hash": str, "model_hash": str,
        "modules": dict, "program": bool,
    },
}  # fmt: skip
"""Types of the entries of config.json. All entries are optional."""

log = logging.getLogger(__name__)


class Run:
    """The folder of a training run."""

    config: dict[str, Any]
    """The content of ``config.json``.

    It has the task, its parameters, the engine, its physics, the seed and all hyperparameters. It also has the
    versions of the packages and of Python, the machine, and the commit.
    """
    metrics: Path
    """Path of ``metrics.csv``, with one row per iteration."""
    policy: Path
    """Path of ``policy.pt``, with the last policy and the value function."""
    best: Path
    """Path of ``best.pt``, with the policy of the best return."""
    checkpoint: Path
    """Path of ``checkpoint.pt``, with the complete state for an exact resume. It is saved with ``policy.pt``."""
    previous: Path
    """Path of ``previous.pt``, the previous checkpoint."""
    teacher: Path
    """Path of ``teacher.pt``: what the policy imitates, if the algorithm has a teacher."""
    replay: Path
    """Path of the folder ``replay``: the replay buffer of the checkpoint, if the algorithm has one."""
    transfer: Path
    """Path of ``transfer.json``, the verdict of ``lw.transfer`` on the last policy."""
    evaluation: Path
    """Path of ``evaluation.json``, the returns of the last and the best policy in new episodes."""
    task_folder: Path
    """Path of the folder ``task``: copies of the task's file, modules and model, unless they are in the package."""
    check: Callable[[], None]
    """Raises an error if another process has taken over the run's lock. ``lw.train`` sets it."""

    def __init__(self, folder: Path, config: dict[str, Any]) -> None:
        self.folder, self.config = folder, config
        self.metrics, self.transfer = folder / "metrics.csv", folder / "transfer.json"
        self.evaluation = folder / "evaluation.json"
        self.policy, self.best = folder / "policy.pt", folder / "best.pt"
        self.checkpoint, self.previous = folder / "checkpoint.pt", folder / "previous.pt"
        self.teacher, self.replay, self.task_folder = folder / "teacher.pt", folder / "replay", folder / _TASK
        self.check = lambda: None

    @property
    def manifest(self) -> dict[str, Any]:
        """The entry ``kept`` of the configuration: the task's name, and the files and hashes of its copy."""
        manifest: dict[str, Any] = self.config.get("kept", {})
        return manifest

    @property
    def task_name(self) -> str:
        """Name of the run's task."""
        task = str(self.manifest.get("name") or self.config.get("task")).partition(":")[0]
        return Path(task).stem if task.endswith(".py") else task

    @staticmethod
    def check_free(folder: str | Path) -> None:
        """Check that a folder can be used for a new run.

        Raises:
            ValueError: The folder is not empty, or is a file.
        """
        folder = Path(folder)
        if (folder / CONFIG).exists():
            way = f", or continue the run (train --resume {folder}, or resume=True in Python)"
            trained = (folder / "checkpoint.pt").exists()  # a planner run has no checkpoint
            raise ValueError(f"{folder} contains a run: use another folder{way if trained else ''}")
        if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - _UNFINISHED):
            raise ValueError(f"{folder} exists and is not an empty folder: use another folder")

    @staticmethod
    def begun(folder: Path) -> bool:
        """Return whether a folder has a run that can be resumed.

        If a process was killed while it created a run, before the first save, what it has left is deleted.
        """
        if (folder / "checkpoint.pt").exists() or (folder / "previous.pt").exists():
            return True
        if (folder / CONFIG).exists() and not (folder / "metrics.csv").exists():
            Run.open(folder)  # raises an error in a planner's folder
            shutil.rmtree(folder)
        return False

    @classmethod
    def create(
        cls,
        folder: str | Path,
        config: Mapping[str, Any],
        *,
        files: Mapping[str, Path | bytes] | None = None,
    ) -> "Run":
        """Create a run folder with a copy of the task, the configuration and the versions.

        The folder is deleted if an error occurs. The task's code is recorded (see ``lyceum_warp.training.runs.trust``),
        so that later commands execute it.

        Args:
            folder: A new or empty folder.
            config: The configuration, as JSON values.
            files: The files of the folder ``task``. The keys are paths in this folder. The values are files to copy, or
                bytes to write.
        """
        folder = Path(folder)
        cls.check_free(folder)
        entries = {"format": FORMAT, **config, "versions": versions(config.get("device", "cpu"))}
        text = json.dumps(entries, indent=2)  # this may fail, so do it before the folder is created
        run, task = cls(folder, json.loads(text)), folder / f"{_TASK}.tmp"
        try:
            shutil.rmtree(task, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)
            for name, content in (files or {}).items():
                path = task / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content if isinstance(content, bytes) else content.read_bytes())
            with replaced(folder / CONFIG) as temporary:
                temporary.write_text(text)
                if files:
                    task.rename(run.task_folder)
        except BaseException:  # for example, the disk is full, or a signal ends the program
            shutil.rmtree(folder, ignore_errors=True)
            raise
        if "file" in run.manifest or "network" in config:
            remember(folder, run.config)
        return run

    @classmethod
    def open(cls, folder: str | Path) -> "Run":
        """Open the run in a folder, and check the types of the entries of its configuration.

        Raises:
            FileNotFoundError: The folder has no run.
            ValueError: The configuration cannot be read, is from a newer release, or is that of a planner.
        """
        path = Path(folder) / CONFIG
        if not path.is_file():
            raise FileNotFoundError(f"there is no run in {folder}{_instead(Path(folder))}")
        try:
            config = json.loads(path.read_text())
            number = config["format"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is not the configuration of a run of lyceum_warp ({error!r})") from error
        if not isinstance(number, int) or number != FORMAT:
            raise unknown_format(path, number, FORMAT)
        if "planner" in config:
            raise ValueError(
                f"{path} is the configuration of a planner, whose folder has no policy: pass the folder of a training "
                f"run, or show the planner's episodes (lyceum-warp view {folder})"
            )
        algorithm = config.get("algorithm")
        try:
            _check_entries(config, _ENTRIES | {str(algorithm): dict, f"{algorithm}_seed": _COUNT})
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        return cls(Path(folder), config)

    def amend(self, **changes: Any) -> None:
        """Change entries of the configuration, in memory and in the file."""
        self.config = {**self.config, **changes}
        replace_text(self.folder / CONFIG, json.dumps(self.config, indent=2))

    def note_settings(self, error: Exception) -> None:
        """Add the path of ``config.json`` to an error that one of its settings may have caused."""
        if str(self.folder) not in str(error):
            error.add_note(f"with the settings in {self.folder / CONFIG}")

    # metrics

    def append(self, row: Mapping[str, Any]) -> None:
        """Append a row to the metrics table. The keys of ``row`` are names of columns.

        New columns are empty in earlier rows. None becomes an empty cell. Floats are written with all digits.
        """
        columns: list[str] = []
        rows: list[list[str]] = []
        if self.metrics.exists():
            with self.metrics.open(newline="") as file:
                reader = csv.reader(file)
                columns = next(reader, [])
                if not row.keys() <= set(columns):
                    rows = list(reader)
        if new := [name for name in row if name not in columns]:
            columns += new
            with replaced(self.metrics) as temporary, temporary.open("w", newline="") as file:
                csv.writer(file).writerows([columns, *(cells + [""] * len(new) for cells in rows)])
        with self.metrics.open("a", newline="") as file:
            csv.writer(file).writerow(map(row.get, columns))  # csv writes None as an empty cell

    def rows(self) -> list[dict[str, float | None]]:
        """Read the rows of the metrics table. Empty cells become None. An incomplete last row is ignored.

        Raises:
            FileNotFoundError: The run has no metrics table yet.
            ValueError: The table cannot be read.
        """
        if not self.metrics.exists():
            raise FileNotFoundError(f"there is no file {self.metrics}, because the run has no complete iteration")
        with self.metrics.open(newline="") as file:
            reader = csv.DictReader((line for line in file if line.endswith("\n")), strict=True)
            try:
                return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
            except (ValueError, TypeError, csv.Error) as error:
                raise ValueError(
                    f"{self.metrics} is not a table of metrics: line {reader.line_num}: {error}"
                ) from error

    def cut(self, iteration: int) -> None:
        """Delete the rows of all iterations after ``iteration`` from the metrics table, and an incomplete last row."""
        if not self.metrics.exists():
            return
        count = sum((row.get("iteration") or 0) <= iteration for row in self.rows())
        with self.metrics.open(newline="") as file:
            lines = [line for line in file if line.strip()]
        if len(lines) > count + 1:
            replace_text(self.metrics, "".join(lines[: count + 1]))

    # policies

    def numbered(self, iteration: int) -> Path:
        """Get the path of an iteration's policy."""
        return self.folder / _POLICIES / f"{iteration:06d}.pt"

    def policy_file(self, which: str | int = "last") -> Path:
        """Get the path of a saved policy.

        Args:
            which: "last", "best", or the number of an iteration.

        Raises:
            FileNotFoundError: The run has no policy of this name or number. The message lists the run's policies.
            ValueError: ``which`` is neither a name nor a number.
        """
        if which == "last":
            path = self.policy
        elif which == "best":
            path = self.best
        elif isinstance(which, int | str) and str(which).isdigit():
            path = self.numbered(int(which))
        else:
            raise ValueError(f"no policy is named {which!r}: pass 'last', 'best' or the number of an iteration")
        if not path.is_file():
            raise FileNotFoundError(f"the run in {self.folder} has no policy {which!r}: it has {self._policies()}")
        return path

    def _policies(self) -> str:
        """List the run's policies, for an error message."""
        names = ["'last'"] * self.policy.is_file() + ["'best'"] * self.best.is_file()
        numbers = sorted(int(path.stem) for path in self.numbered(0).parent.glob("*.pt") if path.stem.isdigit())
        return ", ".join([*names, *map(str, numbers)]) or "none yet"

    def best_score(self) -> tuple[int, float] | None:
        """Read the iteration and the score of the best policy. Return None if there is no best policy."""
        if not self.best.is_file():
            return None
        try:
            content = read_checkpoint(self.best, parts=("iteration", "policy", "score"))
        except ValueError as error:
            cause = str(error).rpartition(": ")[0]
            log.warning("%s: the next evaluated policy replaces this file", cause)
            return None
        return content["iteration"], content["score"]["value"]

    # the checkpoint

    def save(self, content: Mapping[str, Any], state: Mapping[str, Any]) -> None:
        """Replace the last policy and the checkpoint atomically. The old checkpoint becomes ``previous.pt``."""
        write_content(self.policy, content)
        checkpoint = {**content, "state": dict(state)}
        write_content(self.checkpoint, checkpoint, durable=True, previous=self.previous)

    def read(self, device: str | torch.device = "cpu") -> dict[str, Any]:
        """Read the checkpoint's ``iteration``, ``policy``, ``state`` and, if it has one, ``value``.

        If the checkpoint is broken or missing, the previous checkpoint is read instead.

        Args:
            device: Device for the tensors.

        Raises:
            FileNotFoundError: The run has no checkpoint.
            ValueError: The checkpoint is broken, was not written by lyceum_warp, or was written by a newer release.
        """
        try:
            return read_checkpoint(self.checkpoint, device)
        except (ValueError, FileNotFoundError) as error:
            with contextlib.suppress(ValueError, FileNotFoundError):
                content = read_checkpoint(self.previous, device)
                cause = str(error).rpartition(": ")[0]
                done = content["iteration"]
                log.warning("%s: %s, of iteration %d, is used instead", cause, self.previous, done)
                return content
            if isinstance(error, ValueError) and self.policy.is_file():
                raise ValueError(
                    f"{error}, or start a new run with the old run's policy: train --from {self.folder}"
                ) from error
            raise


def _check_entries(entries: Mapping[str, Any], kinds: Mapping[str, Any]) -> None:
    """Check the types of JSON values. A dict of types describes a JSON object."""
    for name in kinds.keys() & entries.keys():
        kind, value = kinds[name], entries[name]
        if kind is _COUNT:
            whole_number(name, value, low=0)
            continue
        python_type = dict if isinstance(kind, dict) else kind
        if not isinstance(value, python_type) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{name} must be of type {getattr(python_type, '__name__', kind)}, not {value!r}")
        if isinstance(kind, dict):
            _check_entries(value, kind)


def runs_in(folder: Path) -> list[str]:
    """Return the paths of the runs in a folder of runs."""
    return sorted(str(path.parent) for path in folder.glob(f"*/{CONFIG}"))


def _instead(folder: Path) -> str:
    """Describe a path that is not the folder of a run, for an error message."""
    if folder.is_file():
        return ", which is a file: pass a run's folder (in Python, lw.load also takes a policy's file)"
    if folder.is_dir():
        runs = runs_in(folder)
        return f": it has no {CONFIG}" + (f"; the last run in this folder is {runs[-1]}" if runs else "")
    if (PRETRAINED / file_name(str(folder)) / CONFIG).is_file():
        return f": for the package's policy, add --pretrained, or open lw.pretrained_run({str(folder)!r})"
    hint = did_you_mean(str(folder), runs_in(folder.parent), "pass the folder that lyceum-warp train or lw.train wrote")
    return f", which does not exist: {hint}"


def load(
    run: str | Path | Run,
    *,
    which: str | int = "last",
    policy: Any = None,
    device: str | torch.device = "cpu",
) -> Any:
    """Load a run's policy, including its observation normaliser. ``policy.act(obs)`` returns actions without noise.

    For a ``GaussianPolicy``, ``policy(obs)`` returns the same mean actions. The parameters are frozen.
    ``NPG(env, policy=lw.load(RUN))`` unfreezes and trains them.

    Args:
        run: A run's folder, a policy file in this folder, or a checkpoint of rsl_rl 5.
        which: "last", "best" (see ``train``), or the number of a saved iteration.
        policy: A policy into which the weights are loaded. Custom classes of policies or networks, and checkpoints of
            rsl_rl, need it. Networks of ``train --network`` do not, on the machine that has trained them.
        device: Device for the parameters.

    Raises:
        FileNotFoundError: The run does not exist, or has no policy of this name or number.
        ValueError: The file is broken, was not written by lyceum_warp, or was written by a newer release. This error is
            also raised if ``policy`` is missing or does not fit the file.
    """
    content, path = _content(run, which, device)
    return policy_of(content, path, policy).to(device).eval().requires_grad_(False)


def policy_of(content: Mapping[str, Any], path: Path, policy: Any = None) -> Any:
    """Make a policy from a file's content, or load the file's weights into ``policy``.

    The class of a network from ``train --network`` is loaded from the run's copy, if this user has run it before.
    """
    folder = path.parents[path.parent.name == _POLICIES]
    shape = content["policy"]["shape"] or {}
    if policy is None and "own" in shape and (folder / CONFIG).is_file():
        run = Run.open(folder)
        if "network" in run.config and is_trusted(folder, run.config):
            spelled = str(run.task_folder / NETWORK / run.config["network"])
            policy = GaussianPolicy.like(shape, made(class_in_file(spelled, nn.Module), shape["nobs"], shape["nact"]))
    return network_of(content, path, "policy", policy)


def load_value(run: str | Path | Run, *, which: str | int = "last", device: str | torch.device = "cpu") -> Any:
    """Load a run's value function, a ``ValueFunction`` that predicts discounted returns by ``value(obs, step)``.

    A run of SAC has a ``TwinCritic`` instead: ``value(obs, unit_action)``.

    Args:
        run: A run's folder, or a file in a run's folder that contains a value function.
        which: See ``load``.
        device: Device for the parameters.

    Raises:
        FileNotFoundError: The run or the file does not exist.
        ValueError: The file has no value function, is broken, was not written by lyceum_warp, or was written by a newer
            release.
    """
    content, path = _content(run, which, device)
    return network_of(content, path, "value").to(device).eval().requires_grad_(False)


def load_curriculum(run: str | Path | Run, *, which: str | int = "last") -> Curriculum | None:
    """Load how far a run's curricula had come when a policy was saved, for ``lw.evaluate`` and ``lw.transfer``.

    The result is None if the task has no such memory, or if an earlier release saved the policy.

    Args:
        run: A run's folder, or a policy file in this folder.
        which: See ``load``.

    Raises:
        FileNotFoundError: The run or the file does not exist.
        ValueError: The file is broken, was not written by lyceum_warp, or was written by a newer release.
    """
    content, path = _content(run, which, "cpu")
    try:
        return Curriculum(**content["curriculum"]) if "curriculum" in content else None
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"the curriculum in {path} is damaged: {error}") from error


def _content(run: str | Path | Run, which: str | int, device: str | torch.device) -> tuple[dict[str, Any], Path]:
    if isinstance(run, (str, Path)) and Path(run).is_file():
        if which != "last":
            raise ValueError(f"{run} is a file with one policy: pass the run's folder to choose {which!r}")
        path = Path(run)
    else:
        run = run if isinstance(run, Run) else Run.open(run)
        path = run.policy_file(which)
    return read_checkpoint(path, device, parts=("iteration", "policy")), path
