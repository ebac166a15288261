"""Call the public functions with random values for each of their arguments.

A case is "CALL SEED", or the name of one of the minimal cases in ``known_failures.py``. The arguments are read from the
signatures, so that a new one is attacked, too.
"""

import dataclasses
import inspect
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import guarded
import numpy as np
import torch
from file_attacks import REFUSALS
from guarded import ProblemError
from mutations import VALUES

import lyceum_warp as lw
from lyceum_warp.algos.mppi_config import SETTINGS
from lyceum_warp.support.validate import described

HERE = Path("keywords").absolute()

OBJECTS: tuple[Any, ...] = (
    *VALUES, *VALUES, torch.tensor(3), torch.tensor(0.5), torch.tensor(True), torch.zeros(2), torch.zeros(0),
    torch.tensor([1.0, torch.nan]), np.float32(2), np.float64(np.nan), np.int64(-1), np.int32(2), np.bool_(True),
    np.zeros(3), np.zeros((2, 2)), np.array("x"), np.array([None]), 1e9, 2.0, 2**40, 1j, b"x", object(), ..., range(3),
    Path("x"), (1, 2), ("qpos",), ("nothing",), {"iterations": 1e9}, {"x": torch.zeros(2)}, frozenset(), "auto",
    "hopper", Exception("x"), iter(()), slice(2),
)  # fmt: skip
"""Values that a program may give by mistake."""


@dataclasses.dataclass(frozen=True)
class Call:
    """A function, arguments with which it works, and the names of all its arguments."""

    function: Callable[..., Any]
    valid: Callable[[], dict[str, Any]]
    names: tuple[str, ...]


def _names(function: Callable[..., Any], *more: str, omit: tuple[str, ...] = ()) -> tuple[str, ...]:
    kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    found = [name for name, p in inspect.signature(function).parameters.items() if p.kind not in kinds]
    return tuple(dict.fromkeys(name for name in (*found, *more) if name not in omit))


def _env(**options: Any) -> lw.Env:
    """An environment that cases share. Each uses it alone, and leaves it in any state."""
    key = repr(options)
    if key not in _ENVS:
        _ENVS[key] = lw.make("point_mass", horizon=4, **options)
    return _ENVS[key]


_ENVS: dict[str, lw.Env] = {}


def _policy() -> lw.GaussianPolicy:
    return lw.GaussianPolicy(6, 2, (4,))


def _npg() -> lw.NPG:
    return lw.NPG(_env(nworld=2), config=lw.NPGConfig(samples=8, hidden=(4,), value_hidden=(4,), mean_every=0))


def _still(state: Any, obs: Any) -> torch.Tensor:
    return torch.zeros(2)


def _plant() -> lw.Env:
    return _env(nworld=1, autoreset=False)


_PLANNER = ("horizon", "samples", *(name for name in SETTINGS if name not in ("horizon", "samples")))
_OPTIONS = tuple(field.name for kind in (lw.EnvOptions, lw.PhysicsOptions) for field in dataclasses.fields(kind))

CALLS = {
    "EnvOptions": Call(lw.EnvOptions, dict, _names(lw.EnvOptions)),
    "PhysicsOptions": Call(lw.PhysicsOptions, dict, _names(lw.PhysicsOptions)),
    "MPPIConfig": Call(lw.MPPIConfig, dict, _names(lw.MPPIConfig)),
    "NPGConfig": Call(lw.NPGConfig, dict, _names(lw.NPGConfig)),
    "make": Call(lw.make, lambda: {"task": "point_mass"}, _names(lw.make, "success_distance")),
    "MPPI": Call(
        lw.MPPI, lambda: {"task": "point_mass", "horizon": 2, "samples": 2}, _names(lw.MPPI, *_PLANNER, *_OPTIONS)
    ),
    "CEM": Call(
        lw.CEM, lambda: {"task": "point_mass", "horizon": 2, "samples": 2}, _names(lw.CEM, *_PLANNER, *_OPTIONS)
    ),
    "NPG": Call(lw.NPG, lambda: {"env": _env(nworld=2)}, _names(lw.NPG)),
    "evaluate": Call(
        lw.evaluate, lambda: {"env": _env(nworld=2), "policy": _policy(), "episodes": 2}, _names(lw.evaluate)
    ),
    "train": Call(
        lw.train, lambda: {"learner": _npg(), "folder": "run", "iterations": 1},
        _names(lw.train, omit=("video_every",)),  # videos are made by another process
    ),
    "control": Call(lw.control, lambda: {"env": _plant(), "controller": _still}, _names(lw.control)),
    "control_async": Call(
        lw.control_async, lambda: {"env": _plant(), "controller": _still}, _names(lw.control_async)
    ),
    "Rollout": Call(lw.Rollout, lambda: {"env": _env(nworld=2), "steps": 2}, _names(lw.Rollout)),
    "OpenLoop": Call(lw.OpenLoop, lambda: {"env": _plant(), "horizon": 2}, _names(lw.OpenLoop)),
    "load": Call(lw.load, lambda: {"run": "good"}, _names(lw.load)),
    "load_value": Call(lw.load_value, lambda: {"run": "good"}, _names(lw.load_value)),
    "GaussianPolicy": Call(lw.GaussianPolicy, lambda: {"nobs": 2, "nact": 2}, _names(lw.GaussianPolicy)),
    "ValueFunction": Call(lw.ValueFunction, lambda: {"nobs": 2}, _names(lw.ValueFunction)),
}  # fmt: skip


def attack(case: str) -> str:
    """Run a case."""
    from known_failures import KEYWORDS

    if case in KEYWORDS:
        known = KEYWORDS[case]
        return call(known.call, dict(known.arguments))
    name = case.rpartition(" ")[0]
    random = Random(case)
    names = CALLS[name].names
    words = random.sample(names, min(len(names), random.choice((1, 1, 1, 2))))
    return call(name, {word: random.choice(OBJECTS) for word in words})


def call(name: str, words: dict[str, Any]) -> str:
    """Call a function with some arguments replaced."""
    shutil.rmtree(HERE / "run", ignore_errors=True)
    shown = f"{name}({', '.join(f'{word}={_shown(value)}' for word, value in words.items())})"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            CALLS[name].function(**CALLS[name].valid() | words)
            return "worked"
        except KeyboardInterrupt:
            raise
        except (*REFUSALS, TypeError) as error:
            refusal = error
        except BaseException as error:
            raise ProblemError(shown, error) from error
    if guarded.out_of_memory(refusal):
        raise ProblemError(f"{shown} takes too much memory", refusal)
    text = str(refusal)
    named = [*words, *(word.replace("_", " ").removesuffix("s") for word in words), *map(_shown, words.values())]
    named += [repr(part) for value in words.values() if isinstance(value, (dict, tuple)) for part in value]
    if "resume" in words:
        named.append("there is no run in run")
    if not any(part in text for part in (*named, *(str(v) for v in words.values() if len(str(v)) > 3))):
        raise ProblemError(f"{shown}: the message has neither the argument's name nor its value", refusal)
    return "refused"


def _shown(value: Any) -> str:
    return described(value) if hasattr(value, "shape") else repr(value)[:60]


def warm_up() -> None:
    """Make a run to load, and make every call once."""
    torch.set_num_threads(1)
    HERE.mkdir(exist_ok=True)
    os.chdir(HERE)
    if not Path("good").exists():
        lw.train(_npg(), "good", iterations=1)
    for name in CALLS:
        call(name, {})


if __name__ == "__main__":
    guarded.serve(attack, warm_up)
