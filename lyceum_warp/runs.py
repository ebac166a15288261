"""Runs: the folder of a training run, its files, and the policies in it."""

import contextlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.checkpoints import (
    FORMAT,
    PolicyContent,
    check_format,
    policy_content,
    policy_of,
    read_checkpoint,
    serialized,
    value_of,
)
from lyceum_warp.files import replaced
from lyceum_warp.metrics_table import append_row, cut_rows, read_metrics
from lyceum_warp.validate import check_kind
from lyceum_warp.versions import versions

_CONFIG, _VERSIONS, _METRICS, _CHECKPOINT = "config.json", "versions.json", "metrics.csv", "checkpoint.pt"
_PREVIOUS, _LAST, _BEST, _NUMBERED = "previous.pt", "policy.pt", "best.pt", "policies"

log = logging.getLogger(__name__)


class Run:
    """The folder of a training run.

    =================== ======================================================================================
    ``config.json``     the task, its parameters, the engine, its physics, the seed and all hyperparameters
    ``versions.json``   versions of the packages and of Python, the machine, the commit
    ``metrics.csv``     one row per iteration
    ``policy.pt``       the policy and the value function after the last iteration
    ``best.pt``         those of the iteration with the best return
    ``policies/``       those of every n-th iteration, if asked for
    ``checkpoint.pt``   the complete state from which a run continues exactly, of the last iteration or an earlier one
    ``previous.pt``     the checkpoint before it
    ``task/``           the task's file with modules beside it, and its model, where they are not the package's
    =================== ======================================================================================

    Args:
        folder: The folder.
        config: The content of ``config.json``.
    """

    def __init__(self, folder: Path, config: dict[str, Any]) -> None:
        self.folder = folder
        self.config = config

    @property
    def metrics(self) -> Path:
        """Path of the table of iterations."""
        return self.folder / _METRICS

    @property
    def checkpoint(self) -> Path:
        """Path of the checkpoint."""
        return self.folder / _CHECKPOINT

    @property
    def previous(self) -> Path:
        """Path of the checkpoint before the last one."""
        return self.folder / _PREVIOUS

    @property
    def task_name(self) -> str:
        """Name of the run's task."""
        task = self.config.get("kept", {}).get("name") or str(self.config.get("task"))
        return Path(task.partition(":")[0]).stem

    @property
    def task_folder(self) -> Path:
        """Path of the folder with the task's file and its model."""
        return self.folder / "task"

    @staticmethod
    def check_free(folder: str | Path, *, resumable: bool = True, command: bool = True) -> None:
        """Check that a folder can be used for a new run.

        Args:
            folder: A folder, which need not exist.
            resumable: Whether the message may suggest to continue the run that is in the folder.
            command: Whether the message names flags of the command line rather than arguments of ``train``.

        Raises:
            ValueError: The folder is not empty, or is a file.
        """
        folder, other = Path(folder), "give another --out" if command else "give another folder"
        if (folder / _CONFIG).exists():
            way = f"--resume {folder}" if command else "resume=True"
            fix = f"continue it with {way}, or {other}" if resumable else other
            raise ValueError(f"{folder} holds a run: {fix}")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} exists and is not an empty folder: {other}")

    @classmethod
    def create(cls, folder: str | Path, config: Mapping[str, Any], *, device: str = "cpu") -> "Run":
        """Begin a run: make its folder, and write the configuration and the versions.

        Args:
            folder: A new or empty folder.
            config: The configuration, of values that JSON can hold.
            device: Device of the run; see ``versions``.

        Raises:
            ValueError: The folder is not empty, or is a file.
        """
        folder = Path(folder)
        cls.check_free(folder, command=False)
        run = cls(folder, {"format": FORMAT, **config})
        text = json.dumps(run.config, indent=2)  # before the folder is made, because it may fail
        new = [path for path in (folder, *folder.parents) if not path.exists()]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _write(folder / _VERSIONS, json.dumps(versions(device), indent=2))
            _write(folder / _CONFIG, text)
        except BaseException:  # a full disk, a folder that cannot be written, a signal
            with contextlib.suppress(OSError):
                for name in (_VERSIONS, _CONFIG):
                    (folder / name).unlink(missing_ok=True)
                for path in new:
                    path.rmdir()
            raise
        return run

    @classmethod
    def open(cls, folder: str | Path) -> "Run":
        """Open the run in a folder.

        Raises:
            FileNotFoundError: There is no run in the folder.
            ValueError: The configuration cannot be read, or was written by a newer release.
        """
        folder = Path(folder)
        path = folder / _CONFIG
        if not path.is_file():
            raise FileNotFoundError(f"there is no run in {folder}: it has no {_CONFIG}")
        try:
            config = json.loads(path.read_text())
            number = config["format"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not the configuration of a run of lyceum_warp ({error!r})") from error
        check_format(path, number)
        return cls(folder, config)

    def amend(self, **changes: Any) -> None:
        """Change entries of the configuration, here and in the file."""
        self.config = {**self.config, **changes}
        _write(self.folder / _CONFIG, json.dumps(self.config, indent=2))

    def changed(self, now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Compare versions with those that the run began with, and note the changes in ``versions.json``.

        Args:
            now: The present versions, as ``versions()`` returns them.

        Returns:
            The changed entries, as (then, now). They are noted under "resumed".
        """
        path = self.folder / _VERSIONS
        try:
            then = json.loads(path.read_text())
        except (OSError, ValueError):
            then = {}
        changed = {name: (then.get(name), value) for name, value in now.items() if then.get(name) != value}
        if changed:
            then.setdefault("resumed", []).append({name: value for name, (_, value) in changed.items()})
            _write(path, json.dumps(then, indent=2))
        return changed

    # the table

    def write(self, row: Mapping[str, Any]) -> None:
        """Append a row to the table; see ``append_row``."""
        append_row(self.metrics, row)

    def rows(self) -> list[dict[str, float | None]]:
        """Read the rows of the table. An empty cell is None.

        Raises:
            FileNotFoundError: The run has no table yet.
            ValueError: The table cannot be read.
        """
        if not self.metrics.exists():
            raise FileNotFoundError(f"there is no {self.metrics}: the run has no complete iteration")
        return read_metrics(self.metrics)

    def cut(self, iteration: int) -> None:
        """Drop the rows after an iteration, and an incomplete last row.

        An interrupted run may have written a row, or a part of one, without its checkpoint.

        Args:
            iteration: Number of the last iteration to keep. The first row may have another number than 1.
        """
        cut_rows(self.metrics, iteration)

    def files(self) -> dict[str, bytes]:
        """The content of versions, table, best policy and task, by their paths below the folder."""
        paths = [self.folder / name for name in (_VERSIONS, _METRICS, _BEST)]
        paths += [path for path in sorted(self.task_folder.rglob("*")) if path.is_file()]
        return {path.relative_to(self.folder).as_posix(): path.read_bytes() for path in paths if path.is_file()}

    # policies

    def policy_file(self, which: str | int = "last") -> Path:
        """Path of a saved policy.

        Args:
            which: "last", "best", or the number of an iteration.

        Raises:
            FileNotFoundError: The run has no such policy; the message lists those that it has.
            ValueError: ``which`` is something else.
        """
        if which == "last":
            # earlier releases kept the policy in the checkpoint alone
            return self.folder / _LAST if (self.folder / _LAST).is_file() else self.checkpoint
        if which == "best":
            path = self.folder / _BEST
        elif (number := _number(which)) is not None:
            path = self._numbered(number)
        else:
            raise ValueError(f"which must be 'last', 'best' or the number of an iteration, not {which!r}")
        if not path.is_file():
            raise FileNotFoundError(
                f"the run in {self.folder} has no policy {which!r}: it has {self._known_policies()}"
            )
        return path

    def _known_policies(self) -> str:
        known = [name for name, file in (("last", _LAST), ("best", _BEST)) if (self.folder / file).is_file()]
        if not known and self.checkpoint.is_file():
            known = ["last"]
        numbers = sorted(int(path.stem) for path in (self.folder / _NUMBERED).glob("*.pt") if path.stem.isdigit())
        return ", ".join([*map(repr, known), *map(str, numbers)]) or "none yet"

    def _numbered(self, iteration: int) -> Path:
        return self.folder / _NUMBERED / f"{iteration:06d}.pt"

    def save_policy(self, content: PolicyContent, *, number: bool = False) -> None:
        """Replace the last policy.

        Args:
            content: The policy and the value function.
            number: Whether to keep it under the number of its iteration, too.
        """
        data = serialized(content)
        if number:
            (self.folder / _NUMBERED).mkdir(exist_ok=True)
            _write_bytes(self._numbered(content["iteration"]), data)
        _write_bytes(self.folder / _LAST, data)

    def save_best(self, content: PolicyContent, name: str, score: float) -> None:
        """Replace the best policy.

        Args:
            content: The policy and the value function.
            name: The column of the table by which it is the best.
            score: The number there.
        """
        _write_bytes(self.folder / _BEST, serialized({**content, "score": {"name": name, "value": score}}))

    def best_score(self) -> tuple[int, float] | None:
        """The iteration and the score of the best policy; None where there is none."""
        if not (self.folder / _BEST).is_file():
            return None
        try:
            content = read_checkpoint(self.folder / _BEST, parts=("iteration", "policy", "score"))
        except ValueError:
            return None
        return content["iteration"], content["score"]["value"]

    # the checkpoint

    def save(
        self, iteration: int, policy: GaussianPolicy, state: Mapping[str, Any], value: ValueFunction | None = None
    ) -> None:
        """Replace the checkpoint; the old one is kept as the previous one.

        A reader finds the old checkpoint or the whole new one.

        Args:
            iteration: Number of complete iterations.
            policy: The policy for ``load``.
            state: State of the algorithm: tensors, numbers, strings and containers of them.
            value: The value function for ``load_value``.
        """
        self.save_state(policy_content(iteration, policy, value), state)

    def save_state(self, content: PolicyContent, state: Mapping[str, Any]) -> None:
        """The same with a policy and a value function that were copied before.

        Args:
            content: The policy and the value function.
            state: State of the algorithm.
        """
        data = serialized({**content, "state": dict(state)})
        with replaced(self.checkpoint, durable=True) as temporary:
            temporary.write_bytes(data)
            if self.checkpoint.exists():
                _keep(self.checkpoint, self.previous)

    def read(self, device: str | torch.device = "cpu", *, note: Callable[[str], None] = log.warning) -> dict[str, Any]:
        """Read the checkpoint: ``iteration``, ``policy``, ``state``, and ``value`` if there is one.

        If it is broken or missing, and the one before it is whole, that one is read.

        Args:
            device: Device for its tensors.
            note: Called with a line that says that the one before it is read.

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
                note(f"{cause}: {self.previous}, of iteration {content['iteration']}, is used instead")
                return content
            if isinstance(error, ValueError) and (self.folder / _LAST).is_file():
                raise ValueError(
                    f"{error}, or begin with the run's policy: train --from {self.folder}, or NPG(env, lw.load(run))"
                ) from error
            raise


def load(
    run: str | Path | Run,
    *,
    which: str | int = "last",
    policy: GaussianPolicy | None = None,
    device: str | torch.device = "cpu",
) -> GaussianPolicy:
    """Load the policy of a run, with its observation normaliser: ``action = policy(obs)`` is the mean action.

    Its parameters are frozen; ``NPG(env, policy=lw.load(RUN))`` trains them further.

    Args:
        run: A run's folder, or a file of it with a policy.
        which: "last", "best" (see ``train``), or the number of an iteration that the run kept.
        policy: A policy that takes the run's weights and is returned; necessary where its network is your own.
        device: Device for its parameters.

    Raises:
        FileNotFoundError: There is no run, or it has no such policy.
        ValueError: The file is broken, was not written by lyceum_warp, or was written by a newer release; or the
            policy in it is of a class of its own and ``policy`` is not given, or does not fit.
    """
    check_kind("policy", policy, GaussianPolicy | None, "as lw.GaussianPolicy(nobs, nact, network=...)")
    content, path = _content(run, which, device)
    return policy_of(content, path, policy).to(device).eval().requires_grad_(False)


def load_value(
    run: str | Path | Run, *, which: str | int = "last", device: str | torch.device = "cpu"
) -> ValueFunction:
    """Load the value function of a run: ``value(obs, step)`` predicts discounted returns.

    Args:
        run: A run's folder, or a file of it with a value function.
        which: As for ``load``.
        device: Device for its parameters.

    Raises:
        FileNotFoundError: There is no run, or it has no such file.
        ValueError: The file holds no value function, is broken, was not written by lyceum_warp, or was written by a
            newer release.
    """
    content, path = _content(run, which, device)
    return value_of(content, path).to(device).eval().requires_grad_(False)


def _content(run: str | Path | Run, which: str | int, device: str | torch.device) -> tuple[PolicyContent, Path]:
    """A saved policy and its file."""
    check_kind("run", run, str | Path | Run, "a run's folder")
    check_kind("which", which, str | int, "as 'last', 'best' or 100")
    check_kind("device", device, str | torch.device, "as 'cpu' or 'cuda:0'")
    try:
        torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"there is no device {device!r}: use one as 'cpu' or 'cuda:0'") from error
    if isinstance(run, (str, Path)) and Path(run).is_file():
        if which != "last":
            raise ValueError(f"{run} is a file with one policy: give the run's folder to choose {which!r}")
        path = Path(run)
    else:
        run = run if isinstance(run, Run) else Run.open(run)
        path = run.policy_file(which)
    return read_checkpoint(path, device, parts=("iteration", "policy")), path


def _write(path: Path, text: str) -> None:
    with replaced(path) as temporary:
        temporary.write_text(text)


def _write_bytes(path: Path, data: memoryview) -> None:
    with replaced(path) as temporary:
        temporary.write_bytes(data)


def _keep(path: Path, other: Path) -> None:
    """Give a file a second name, in place of another file. It exists under its first name all the time."""
    temporary = other.with_name(other.name + ".tmp")
    try:
        temporary.unlink(missing_ok=True)
        os.link(path, temporary)
        os.replace(temporary, other)
    except OSError:  # a file system without links
        os.replace(path, other)


def _number(which: Any) -> int | None:
    """The number of an iteration, also where it is written as a text."""
    if isinstance(which, int) and not isinstance(which, bool):
        return which
    return int(which) if isinstance(which, str) and which.isdigit() else None
