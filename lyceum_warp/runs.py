"""Runs: a folder with a training run's configuration, versions, metrics and checkpoint."""

import csv
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.versions import versions

Module = TypeVar("Module", bound=nn.Module)

FORMAT = 1
"""Format of the folder; one more whenever an older release could no longer read it."""

_CONFIG, _VERSIONS, _METRICS, _CHECKPOINT = "config.json", "versions.json", "metrics.csv", "checkpoint.pt"


class Run:
    """A training run's folder.

    =================== ======================================================================================
    ``config.json``     the task, its parameters, the engine, its physics, the seed and every hyperparameter
    ``versions.json``   what it ran with: packages, Python, machine, commit
    ``metrics.csv``     one row an iteration
    ``checkpoint.pt``   the policy, and all that is needed to continue exactly
    =================== ======================================================================================

    Args:
        folder: Where the files lie.
        config: What ``config.json`` holds.
    """

    def __init__(self, folder: Path, config: dict[str, Any]) -> None:
        self.folder = folder
        self.config = config

    @property
    def metrics(self) -> Path:
        """The table of iterations."""
        return self.folder / _METRICS

    @property
    def checkpoint(self) -> Path:
        """The file to continue from."""
        return self.folder / _CHECKPOINT

    @staticmethod
    def check_free(folder: str | Path, *, resumable: bool = True) -> None:
        """Refuse a folder that a new run can't have.

        Args:
            folder: The folder.
            resumable: Whether to say how to continue what is in it.

        Raises:
            ValueError: There is something in it already.
        """
        folder = Path(folder)
        if (folder / _CONFIG).exists():
            mend = f"continue it with --resume {folder}, or give another --out" if resumable else "give another --out"
            raise ValueError(f"{folder} holds a run: {mend}")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} exists and is not an empty folder: give another --out")

    @classmethod
    def create(cls, folder: str | Path, config: Mapping[str, Any], *, device: str = "cpu") -> "Run":
        """Begin a run: make its folder, with the configuration and the versions.

        Args:
            folder: A new or empty folder.
            config: What JSON can hold.
            device: The device that it runs on, for the record.

        Raises:
            ValueError: There is something in the folder already.
        """
        folder = Path(folder)
        cls.check_free(folder)
        run = cls(folder, {"format": FORMAT, **config})
        text = json.dumps(run.config, indent=2)  # before the folder is made, in case it can't be written
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / _VERSIONS, json.dumps(versions(device), indent=2))
        _write(folder / _CONFIG, text)
        return run

    @classmethod
    def open(cls, folder: str | Path) -> "Run":
        """A run that is there.

        Raises:
            FileNotFoundError: There is no run in the folder.
            ValueError: Its configuration can't be read, or a newer release wrote it.
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
        """Change entries of the configuration, in the file, too."""
        self.config = {**self.config, **changes}
        _write(self.folder / _CONFIG, json.dumps(self.config, indent=2))

    def changed(self, now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Packages, Python and processors that are not those that the run began with, as (then, now).

        They are also noted in ``versions.json``, under "resumed".
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

    def write(self, record: Mapping[str, Any]) -> None:
        """Append an iteration to the table. None is an empty cell; floats are written with all their digits."""
        exists = self.metrics.exists() and self.metrics.stat().st_size > 0
        with self.metrics.open("a", newline="") as file:
            writer = csv.writer(file)
            if not exists:
                writer.writerow(record)
            writer.writerow(["" if value is None else value for value in record.values()])

    def rows(self) -> list[dict[str, float | None]]:
        """The table; None where a cell is empty.

        Raises:
            FileNotFoundError: There is none yet.
            ValueError: It can't be read.
        """
        if not self.metrics.exists():
            raise FileNotFoundError(f"{self.metrics} is not there: the run has no complete iteration")
        return read_metrics(self.metrics)

    def cut(self, iteration: int) -> None:
        """Drop the rows after an iteration, and a last row that was written only in part.

        Rows count from 1. An interrupted run may have written a row without the checkpoint that belongs to it.
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
        """Replace the checkpoint, in one go: a reader finds the old one or the new one, never a part.

        Args:
            iteration: Number of complete iterations.
            policy: The policy that ``load`` will give back.
            state: What the algorithm continues from; tensors, numbers, strings and containers of them.
            value: The value function that ``load_value`` will give back.
        """
        content: dict[str, Any] = {
            "lyceum_warp": FORMAT,
            "iteration": iteration,
            "policy": {"shape": policy.shape, "state": policy.state_dict()},
            "state": dict(state),
        }
        if value is not None:
            content["value"] = {"shape": value.shape, "state": value.state_dict()}
        temporary = self.checkpoint.with_suffix(".tmp")
        try:
            torch.save(content, temporary)
            os.replace(temporary, self.checkpoint)
        finally:
            temporary.unlink(missing_ok=True)

    def read(self, device: str | torch.device = "cpu") -> dict[str, Any]:
        """The checkpoint: ``iteration``, ``policy``, and ``state`` as it was saved.

        Raises:
            FileNotFoundError: There is none.
            ValueError: It is broken, foreign, or of a newer release.
        """
        return read_checkpoint(self.checkpoint, device)


def load(run: str | Path | Run, *, device: str | torch.device = "cpu") -> GaussianPolicy:
    """The policy of a run, its observation normaliser included, for use: ``action = policy(obs)`` is the mean action.

    Args:
        run: A run's folder, or a checkpoint file.
        device: Where its parameters go.

    Raises:
        FileNotFoundError: There is no run, or it has no checkpoint.
        ValueError: The checkpoint is broken, foreign, or of a newer release.
    """
    return _module(run, "policy", GaussianPolicy, device)


def load_value(run: str | Path | Run, *, device: str | torch.device = "cpu") -> ValueFunction:
    """The value function of a run, for use: ``value(obs, step)`` predicts discounted returns.

    Args:
        run: A run's folder, or a checkpoint file.
        device: Where its parameters go.

    Raises:
        FileNotFoundError: There is no run, or it has no checkpoint.
        ValueError: The checkpoint holds no value function, is broken, foreign, or of a newer release.
    """
    return _module(run, "value", ValueFunction, device)


def _module(run: str | Path | Run, name: str, kind: Callable[..., Module], device: str | torch.device) -> Module:
    if isinstance(run, (str, Path)) and Path(run).is_file():
        path = Path(run)
    else:
        path = (run if isinstance(run, Run) else Run.open(run)).checkpoint
    try:
        saved = read_checkpoint(path, device)[name]
        module = kind(**saved["shape"])
        module.load_state_dict(saved["state"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path} holds no {name} of lyceum_warp ({_line(error)}): {_MEND}") from error
    return module.to(device).eval().requires_grad_(False)


_MEND = "restore the file from a copy, or train again with another --out"


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """A checkpoint's content. Nothing in the file is run.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is broken, foreign, or of a newer release.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint {path}: train the run first")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds, depending on where the file ends
        raise ValueError(
            f"the checkpoint {path} is cut off, or was not written by lyceum_warp ({_line(error)}): {_MEND}"
        ) from error
    if not isinstance(content, dict) or "lyceum_warp" not in content:
        raise ValueError(f"the checkpoint {path} was not written by lyceum_warp: {_MEND}")
    _check_format(path, content["lyceum_warp"])
    if missing := {"iteration", "policy", "state"} - content.keys():
        raise ValueError(f"the checkpoint {path} lacks {', '.join(sorted(missing))}: {_MEND}")
    return content


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """The rows of a table of metrics; None where a cell is empty.

    Raises:
        ValueError: A cell is no number, or a row has another number of cells than the first.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            return [{key: float(cell) if cell else None for key, cell in row.items()} for row in reader]
        except (ValueError, TypeError, csv.Error) as error:
            raise ValueError(f"{path} is no table of metrics: line {reader.line_num}: {error}") from error


def _check_format(path: Path, number: Any) -> None:
    if not isinstance(number, int) or number < 1:
        raise ValueError(f"{path} was not written by lyceum_warp: its format is {number!r}")
    if number > FORMAT:
        raise ValueError(
            f"{path} was written by a newer lyceum_warp (format {number}, this one reads up to {FORMAT}): "
            "pip install --upgrade lyceum-warp"
        )


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def _line(error: BaseException) -> str:
    """The first sentence of an error's message: torch's go on for a page."""
    text = str(error).strip() or type(error).__name__
    return text.splitlines()[0].split(". ")[0][:200]
