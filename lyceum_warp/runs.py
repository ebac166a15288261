"""Runs: the folder of a training run, with its configuration, versions, metrics, policies and checkpoint."""

import contextlib
import csv
import io
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.env import Env
from lyceum_warp.files import newer_format, replaced
from lyceum_warp.versions import versions

Module = TypeVar("Module", bound=nn.Module)

FORMAT = 1
"""Format of the folder. It is raised when an older release could no longer read the folder."""

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
    ``task/``           the task's file and its model, where they are not the package's
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
        _check_format(path, number)
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
        """Append a row to the table. A column that is new, as after an update of the task, is empty in earlier rows.

        Args:
            row: Values by the names of their columns. None becomes an empty cell; floats keep all their digits.
        """
        columns = self._columns()
        if new := [name for name in row if name not in columns]:
            cells = []
            if columns:
                with self.metrics.open(newline="") as file:
                    cells = [line + [""] * len(new) for line in list(csv.reader(file))[1:]]
            columns += new
            with replaced(self.metrics) as temporary, temporary.open("w", newline="") as file:
                csv.writer(file).writerows([columns, *cells])
        with self.metrics.open("a", newline="") as file:
            values = (row.get(name) for name in columns)
            csv.writer(file).writerow(["" if value is None else value for value in values])

    def _columns(self) -> list[str]:
        """The names in the table's header; none where there is no table yet."""
        if not self.metrics.exists():
            return []
        with self.metrics.open(newline="") as file:
            return next(csv.reader(file), [])

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
        if not self.metrics.exists():
            return
        lines = self.metrics.read_text().splitlines(keepends=True)
        column = next((i for i, name in enumerate(_cells(lines[0])) if name == "iteration"), None) if lines else None
        kept = [
            line for i, line in enumerate(lines)
            if line.endswith("\n") and (i == 0 or _number_of_row(line, column, i) <= iteration)
        ]  # fmt: skip
        if kept != lines:
            _write(self.metrics, "".join(kept))

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

    def save_policy(self, content: "PolicyContent", *, number: bool = False) -> None:
        """Replace the last policy.

        Args:
            content: The policy and the value function.
            number: Whether to keep it under the number of its iteration, too.
        """
        data = _serialized(content)
        if number:
            (self.folder / _NUMBERED).mkdir(exist_ok=True)
            _write_bytes(self._numbered(content["iteration"]), data)
        _write_bytes(self.folder / _LAST, data)

    def save_best(self, content: "PolicyContent", name: str, score: float) -> None:
        """Replace the best policy.

        Args:
            content: The policy and the value function.
            name: The column of the table by which it is the best.
            score: The number there.
        """
        _write_bytes(self.folder / _BEST, _serialized({**content, "score": {"name": name, "value": score}}))

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

    def save_state(self, content: "PolicyContent", state: Mapping[str, Any]) -> None:
        """The same with a policy and a value function that were copied before.

        Args:
            content: The policy and the value function.
            state: State of the algorithm.
        """
        data = _serialized({**content, "state": dict(state)})
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
                raise ValueError(f"{error}, or begin with the run's policy: --from {self.folder}") from error
            raise


PolicyContent = dict[str, Any]
"""A policy and a value function as they are saved: ``iteration``, ``policy``, and ``value`` if there is one."""


def policy_content(iteration: int, policy: GaussianPolicy, value: ValueFunction | None = None) -> PolicyContent:
    """A copy of a policy and of a value function on the CPU.

    Args:
        iteration: Number of complete iterations.
        policy: The policy.
        value: The value function.
    """
    content: PolicyContent = {"lyceum_warp": FORMAT, "iteration": iteration}
    for name, module in (("policy", policy), ("value", value)):
        if module is not None:
            content[name] = {
                "shape": module.shape,
                "state": {key: tensor.detach().cpu().clone() for key, tensor in module.state_dict().items()},
            }
    return content


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
    content, path = _content(run, which, device)
    return _policy(content, path, policy).to(device).eval().requires_grad_(False)


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
    return _filled(content, path, "value", lambda shape: ValueFunction(**shape)).to(device).eval().requires_grad_(False)


_FIX = "restore the file from a copy, or train again with another --out"


def _content(run: str | Path | Run, which: str | int, device: str | torch.device) -> tuple[PolicyContent, Path]:
    """A saved policy and its file."""
    if isinstance(run, (str, Path)) and Path(run).is_file():
        if which != "last":
            raise ValueError(f"{run} is a file with one policy: give the run's folder to choose {which!r}")
        path = Path(run)
    else:
        run = run if isinstance(run, Run) else Run.open(run)
        path = run.policy_file(which)
    return read_checkpoint(path, device, parts=("iteration", "policy")), path


def networks(content: PolicyContent, path: Path) -> tuple[GaussianPolicy, ValueFunction]:
    """The policy and the value function of a checkpoint, to be trained further.

    Args:
        content: The content of the checkpoint.
        path: Its file, for messages.

    Raises:
        ValueError: The checkpoint holds something else.
    """
    return _policy(content, path, None), _filled(content, path, "value", lambda shape: ValueFunction(**shape))


def _policy(content: PolicyContent, path: Path, given: GaussianPolicy | None) -> GaussianPolicy:
    if given is None:
        return _filled(content, path, "policy", GaussianPolicy.like)
    return _filled(content, path, "policy", lambda shape: given, fix="give one like that of the run")


def _filled(
    content: PolicyContent, path: Path, name: str, made: Callable[[Mapping[str, Any]], Module], *, fix: str = _FIX
) -> Module:
    """A network with the weights of a checkpoint."""
    try:
        saved = content[name]
        module = made(saved["shape"])
        if different := _difference(module, saved["state"]):
            raise ValueError(f"{path} holds a {name} of other parameters ({different}): {fix}")
        module.load_state_dict(saved["state"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path} holds no {name} of lyceum_warp ({_first_sentence(error)}): {_FIX}") from error
    return module


def check_sizes(policy: Any, env: Env, path: Path) -> None:
    """Refuse a policy that was trained on observations or actions of other sizes.

    Args:
        policy: The policy.
        env: The environment that it is to act in.
        path: Where it is from, for the message.

    Raises:
        ValueError: The sizes differ.
    """
    sizes, wanted = (policy.nobs, policy.nact), (env.obs_space.size, env.action_space.size)
    if sizes != wanted:
        raise ValueError(
            f"the policy in {path} takes {sizes[0]} observations and gives {sizes[1]} actions, but the task "
            f"{env.task.name!r} has {wanted[0]} and {wanted[1]}: use a task with the sizes that it was trained on"
        )


def _difference(module: nn.Module, state: Mapping[str, torch.Tensor]) -> str:
    """The first difference between a module's weights and saved ones; empty where there is none."""
    own, saved = ({name: tuple(part.shape) for name, part in s.items()} for s in (module.state_dict(), state))
    saved = {name: own[name] for name in getattr(module, "LATER", ())} | saved
    for name in {**own, **saved}:
        if own.get(name) != saved.get(name):
            one, other = (f"{shape}" if shape is not None else "absent" for shape in (saved.get(name), own.get(name)))
            return f"{name!r} is {one} in the file, and {other} in the network that takes it"
    return ""


def read_checkpoint(
    path: Path, device: str | torch.device = "cpu", *, parts: tuple[str, ...] = ("iteration", "policy", "state")
) -> dict[str, Any]:
    """Read the content of a checkpoint, or of a saved policy. No code in the file is executed.

    Args:
        path: The file.
        device: Device for its tensors.
        parts: What it must hold.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The checkpoint is broken, was not written by lyceum_warp, or was written by a newer release.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint {path}: train the run first")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # of many types, from torch
        raise ValueError(
            f"the checkpoint {path} is cut off, or was not written by lyceum_warp ({_first_sentence(error)}): {_FIX}"
        ) from error
    if not isinstance(content, dict) or "lyceum_warp" not in content:
        raise ValueError(f"the checkpoint {path} was not written by lyceum_warp: {_FIX}")
    _check_format(path, content["lyceum_warp"])
    if missing := set(parts) - content.keys():
        raise ValueError(f"the checkpoint {path} lacks {', '.join(sorted(missing))}: {_FIX}")
    return content


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """Read the rows of a table of metrics. An empty cell is None.

    Raises:
        ValueError: A cell is not a number, or the rows differ in length.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
        except (ValueError, TypeError, csv.Error) as error:
            raise ValueError(f"{path} is not a table of metrics: line {reader.line_num}: {error}") from error


def _check_format(path: Path, number: Any) -> None:
    if not isinstance(number, int) or number < 1:
        raise ValueError(f"{path} was not written by lyceum_warp: its format is {number!r}")
    if number > FORMAT:
        raise newer_format(path, number, FORMAT)


def _write(path: Path, text: str) -> None:
    with replaced(path) as temporary:
        temporary.write_text(text)


def _cells(line: str) -> list[str]:
    return next(csv.reader([line]), [])


def _number_of_row(line: str, column: int | None, otherwise: int) -> float:
    """The iteration of a row; another number where it has no such column."""
    try:
        return otherwise if column is None else float(_cells(line)[column])
    except (ValueError, IndexError, csv.Error):  # read_metrics names the line
        return otherwise


def _serialized(content: Any) -> memoryview:
    """The bytes of a file. Written by Python they raise OSError on a full disk, where torch has errors of its own."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getbuffer()


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


def _first_sentence(error: BaseException) -> str:
    """The first sentence of an error's message; torch's messages fill a page."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0].split(". ")[0][:200]
