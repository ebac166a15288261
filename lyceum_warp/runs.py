"""Runs: the folder of a training run, with its configuration, versions, metrics and checkpoint."""

import csv
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.files import newer_format, replaced
from lyceum_warp.versions import versions

Module = TypeVar("Module", bound=nn.Module)

FORMAT = 1
"""Format of the folder. It is raised when an older release could no longer read the folder."""

_CONFIG, _VERSIONS, _METRICS, _CHECKPOINT = "config.json", "versions.json", "metrics.csv", "checkpoint.pt"


class Run:
    """The folder of a training run.

    =================== ======================================================================================
    ``config.json``     the task, its parameters, the engine, its physics, the seed and all hyperparameters
    ``versions.json``   versions of the packages and of Python, the machine, the commit
    ``metrics.csv``     one row per iteration
    ``checkpoint.pt``   the policy, and the state from which a run continues exactly
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

    @staticmethod
    def check_free(folder: str | Path, *, resumable: bool = True) -> None:
        """Check that a folder can be used for a new run.

        Args:
            folder: A folder, which need not exist.
            resumable: Whether the message may suggest to continue the run that is in the folder.

        Raises:
            ValueError: The folder is not empty, or is a file.
        """
        folder = Path(folder)
        if (folder / _CONFIG).exists():
            fix = f"continue it with --resume {folder}, or give another --out" if resumable else "give another --out"
            raise ValueError(f"{folder} holds a run: {fix}")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} exists and is not an empty folder: give another --out")

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
        cls.check_free(folder)
        run = cls(folder, {"format": FORMAT, **config})
        text = json.dumps(run.config, indent=2)  # before the folder is made, because it may fail
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / _VERSIONS, json.dumps(versions(device), indent=2))
        _write(folder / _CONFIG, text)
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
            iteration: Number of the last iteration to keep; the first one is 1.
        """
        if not self.metrics.exists():
            return
        lines = self.metrics.read_text().splitlines(keepends=True)
        kept = [line for line in lines[: iteration + 1] if line.endswith("\n")]
        if kept != lines:
            _write(self.metrics, "".join(kept))

    # the checkpoint

    def save(
        self, iteration: int, policy: GaussianPolicy, state: Mapping[str, Any], value: ValueFunction | None = None
    ) -> None:
        """Replace the checkpoint. A reader finds the old one or the whole new one.

        Args:
            iteration: Number of complete iterations.
            policy: The policy for ``load``.
            state: State of the algorithm: tensors, numbers, strings and containers of them.
            value: The value function for ``load_value``.
        """
        content: dict[str, Any] = {
            "lyceum_warp": FORMAT,
            "iteration": iteration,
            "policy": {"shape": policy.shape, "state": policy.state_dict()},
            "state": dict(state),
        }
        if value is not None:
            content["value"] = {"shape": value.shape, "state": value.state_dict()}
        with replaced(self.checkpoint) as temporary:
            torch.save(content, temporary)

    def read(self, device: str | torch.device = "cpu") -> dict[str, Any]:
        """Read the checkpoint: ``iteration``, ``policy``, ``state``, and ``value`` if there is one.

        Raises:
            FileNotFoundError: The run has no checkpoint.
            ValueError: The checkpoint is broken, was not written by lyceum_warp, or was written by a newer release.
        """
        return read_checkpoint(self.checkpoint, device)


def load(
    run: str | Path | Run, *, policy: GaussianPolicy | None = None, device: str | torch.device = "cpu"
) -> GaussianPolicy:
    """Load the policy of a run, with its observation normaliser: ``action = policy(obs)`` is the mean action.

    Args:
        run: A run's folder, or a checkpoint file.
        policy: A policy that takes the run's weights and is returned; necessary where its network is your own.
        device: Device for its parameters.

    Raises:
        FileNotFoundError: There is no run, or it has no checkpoint.
        ValueError: The checkpoint is broken, was not written by lyceum_warp, or was written by a newer release; or the
            policy in it is of a class of its own and ``policy`` is not given, or does not fit.
    """

    def made(**shape: Any) -> GaussianPolicy:
        return GaussianPolicy.like(shape) if policy is None else policy

    return _module(run, "policy", made, device, fix=_FIX if policy is None else "give one like that of the run")


def load_value(run: str | Path | Run, *, device: str | torch.device = "cpu") -> ValueFunction:
    """Load the value function of a run: ``value(obs, step)`` predicts discounted returns.

    Args:
        run: A run's folder, or a checkpoint file.
        device: Device for its parameters.

    Raises:
        FileNotFoundError: There is no run, or it has no checkpoint.
        ValueError: The checkpoint holds no value function, is broken, was not written by lyceum_warp, or was written
            by a newer release.
    """
    return _module(run, "value", ValueFunction, device)


_FIX = "restore the file from a copy, or train again with another --out"


def _module(
    run: str | Path | Run, name: str, kind: Callable[..., Module], device: str | torch.device, *, fix: str = _FIX
) -> Module:
    if isinstance(run, (str, Path)) and Path(run).is_file():
        path = Path(run)
    else:
        path = (run if isinstance(run, Run) else Run.open(run)).checkpoint
    try:
        saved = read_checkpoint(path, device)[name]
        module = kind(**saved["shape"])
        if different := _difference(module, saved["state"]):
            raise ValueError(f"{path} holds a {name} of other parameters ({different}): {fix}")
        module.load_state_dict(saved["state"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path} holds no {name} of lyceum_warp ({_first_sentence(error)}): {_FIX}") from error
    return module.to(device).eval().requires_grad_(False)


def _difference(module: nn.Module, state: Mapping[str, torch.Tensor]) -> str:
    """The first difference between a module's weights and saved ones; empty where there is none."""
    own, saved = ({name: tuple(part.shape) for name, part in s.items()} for s in (module.state_dict(), state))
    saved = {name: own[name] for name in getattr(module, "LATER", ())} | saved
    for name in {**own, **saved}:
        if own.get(name) != saved.get(name):
            one, other = (f"{shape}" if shape is not None else "absent" for shape in (saved.get(name), own.get(name)))
            return f"{name!r} is {one} in the file, and {other} in the network that takes it"
    return ""


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read the content of a checkpoint. No code in the file is executed.

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
    if missing := {"iteration", "policy", "state"} - content.keys():
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


def _first_sentence(error: BaseException) -> str:
    """The first sentence of an error's message; torch's messages fill a page."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0].split(". ")[0][:200]
