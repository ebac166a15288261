"""Call public functions with random values for each argument.

A case is "CALL SEED" or the name of a case in ``minimal_cases.py``.
"""

import dataclasses
import functools
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
from minimal_cases import KEYWORDS
from mutations import VALUES

import lyceum_warp as lw
from lyceum_warp.algos.planning.config import SETTINGS
from lyceum_warp.support.validate import described

HERE = Path("keywords").absolute()

OBJECTS: tuple[Any, ...] = (
    *VALUES, *VALUES, torch.tensor(3), torch.tensor(0.5), torch.tensor(True), torch.zeros(2), torch.zeros(0),
    torch.tensor([1.0, torch.nan]), np.float32(2), np.float64(np.nan), np.int64(-1), np.int32(2), np.bool_(True),
    np.zeros(3), np.zeros((2, 2)), np.array("x"), np.array([None]), 1e9, 2.0, 2**40, 1j, b"x", object(), ..., range(3),
    Path("x"), (1, 2), ("qpos",), ("nothing",), {"iterations": 1e9}, {"x": torch.zeros(2)}, frozenset(), "auto",
    "hopper", Exception("x"), iter(()), slice(2),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Call:
    """A function, its valid arguments, and further keyword arguments that its signature does not name."""

    function: Callable[..., Any]
    valid: Callable[[], dict[str, Any]]
    more: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Return the names of the arguments that cases replace."""
        variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        parameters = inspect.signature(self.function).parameters
        names = [name for name, parameter in parameters.items() if parameter.kind not in variable]
        return list(dict.fromkeys((*names, *self.more)))


@functools.cache
def _env(**options: Any) -> lw.Env:
    """Cases share this environment and may leave it in any state."""
    return lw.make("point_mass", horizon=4, **options)


def _npg() -> lw.NPG:
    return lw.NPG(_env(nworld=2), config=lw.NPGConfig(samples=8, hidden=(4,), value_hidden=(4,), mean_every=0))


def _still(state: Any, obs: Any) -> torch.Tensor:
    return torch.zeros(2)


def _plant() -> lw.Env:
    return _env(nworld=1, autoreset=False)


def _planner() -> dict[str, Any]:
    return {"task": "point_mass", "horizon": 2, "samples": 2}


_OPTIONS = tuple(field.name for kind in (lw.EnvOptions, lw.PhysicsOptions) for field in dataclasses.fields(kind))

CALLS = {
    "EnvOptions": Call(lw.EnvOptions, dict),
    "PhysicsOptions": Call(lw.PhysicsOptions, dict),
    "MPPIConfig": Call(lw.MPPIConfig, dict),
    "NPGConfig": Call(lw.NPGConfig, dict),
    "make": Call(lw.make, lambda: {"task": "point_mass"}, ("success_distance",)),
    "MPPI": Call(lw.MPPI, _planner, (*SETTINGS, *_OPTIONS)),
    "CEM": Call(lw.CEM, _planner, (*SETTINGS, *_OPTIONS)),
    "NPG": Call(lw.NPG, lambda: {"env": _env(nworld=2)}),
    "evaluate": Call(lw.evaluate, lambda: {"env": _env(nworld=2), "policy": _npg().policy, "episodes": 2}),
    "train": Call(lw.train, lambda: {"learner": _npg(), "run": "run", "iterations": 1}),
    "control": Call(lw.control, lambda: {"env": _plant(), "controller": _still}),
    "control_async": Call(lw.control_async, lambda: {"env": _plant(), "controller": _still}),
    "Rollout": Call(lw.Rollout, lambda: {"env": _env(nworld=2), "steps": 2}),
    "OpenLoop": Call(lw.OpenLoop, lambda: {"env": _plant(), "horizon": 2}),
    "load": Call(lw.load, lambda: {"run": "good"}),
    "load_value": Call(lw.load_value, lambda: {"run": "good"}),
    "GaussianPolicy": Call(lw.GaussianPolicy, lambda: {"nobs": 2, "nact": 2}),
    "ValueFunction": Call(lw.ValueFunction, lambda: {"nobs": 2}),
}


def attack(case: str) -> None:
    if case in KEYWORDS:
        call(*KEYWORDS[case])
        return
    name = case.rpartition(" ")[0]
    random = Random(case)
    names = CALLS[name].names
    words = random.sample(names, min(len(names), random.choice((1, 1, 1, 2))))
    call(name, {word: random.choice(OBJECTS) for word in words})


def call(name: str, words: dict[str, Any]) -> None:
    shutil.rmtree(HERE / "run", ignore_errors=True)
    shown = f"{name}({', '.join(f'{word}={_shown(value)}' for word, value in words.items())})"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            CALLS[name].function(**CALLS[name].valid() | words)
            return
        except KeyboardInterrupt:
            raise
        except (*REFUSALS, TypeError) as error:
            refusal = error
        except BaseException as error:
            raise ProblemError(shown, error) from error
    if guarded.out_of_memory(refusal):
        raise ProblemError(f"{shown}: the call takes too much memory", refusal)
    text = str(refusal)
    named = [*words, *(word.replace("_", " ").removesuffix("s") for word in words), *map(_shown, words.values())]
    named += [repr(part) for value in words.values() if isinstance(value, (dict, tuple)) for part in value]
    if not any(part in text for part in (*named, *(str(v) for v in words.values() if len(str(v)) > 3))):
        raise ProblemError(f"{shown}: the message has neither the argument's name nor its value", refusal)


def _shown(value: Any) -> str:
    return described(value) if hasattr(value, "shape") else repr(value)[:60]


def warm_up() -> None:
    torch.set_num_threads(1)
    HERE.mkdir(exist_ok=True)
    os.chdir(HERE)
    if not Path("good").exists():
        lw.train(_npg(), "good", 1)
    for name in CALLS:
        call(name, {})


if __name__ == "__main__":
    guarded.serve(attack, warm_up)
