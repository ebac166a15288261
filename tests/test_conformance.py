"""Every task of the package keeps the rules of an environment on every engine, and a third engine does, too."""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import settle
from toy_engine import ToyEngine

import lyceum_warp as lw
from lyceum_warp.binding.registry import find_task
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.graphs.recorder import Recorder
from lyceum_warp.testing import CHECKS, check_task

PACKAGE = [name for name in lw.task_names() if find_task(name).__module__.startswith("lyceum_warp.tasks.")]


@pytest.fixture(autouse=True)
def settled_again() -> None:
    """Rules about memory look through all objects, and each engine loads kernels of its own."""
    settle()


@pytest.mark.parametrize("task", PACKAGE)
def test_mujoco_engine(task: str) -> None:
    # whatever an environment leaves behind in the long run, it does so with any task
    report = check_task(task, engine="mujoco", steps=1000 if task == "hopper" else 300)
    assert list(report.seconds) == [check.__name__.removeprefix("check_") for check in CHECKS]


@pytest.mark.parametrize("task", PACKAGE)
def test_warp_engine(task: str) -> None:
    # on the CPU, where a step takes milliseconds, this engine is there for tests: one task for long and as it is
    if task == "hopper":
        check_task(task, engine="warp", steps=600)  # enough to see a number that each step keeps
    else:
        check_task(task, engine="warp", steps=100, frame_skip=min(2, find_task(task).frame_skip))


@pytest.mark.parametrize("task", ["hopper", "point_mass", "humanoid"])
def test_toy_engine(task: str) -> None:
    assert f"{task} on the toy engine" in str(check_task(task, engine=ToyEngine, steps=200))


# every check can fail: an environment is broken in one place, and the check has to see it

Method = Callable[..., Any]


def then(extra: Callable[[Any], object]) -> Callable[[Method], Method]:
    """Do something more after every call of a method."""

    def wrap(method: Method) -> Method:
        def longer(self: Any, *args: Any, **kwargs: Any) -> Any:
            result = method(self, *args, **kwargs)
            extra(self)
            return result

        return longer

    return wrap


def nothing(method: Method) -> Method:
    return lambda *args, **kwargs: None


counter = itertools.count(1)
leak: list[bytes] = []


def skip_some(method: Method) -> Method:
    def call(self: Recorder, function: Method, *args: Any) -> None:
        if not self.enabled or next(counter) % 10:
            method(self, function, *args)

    return call


def keep_warm_start(engine: MujocoEngine) -> None:
    warm = mujoco.mjtState.mjSTATE_WARMSTART.value
    start = mujoco.mj_stateSize(engine.model, mujoco.mjtState.mjSTATE_INTEGRATION.value & (warm - 1))
    engine._initial.numpy()[start : start + engine.model.nv] = np.nan


BREAKS: list[tuple[str, type, str, Callable[[Method], Method]]] = [
    ("spaces", lw.Env, "_allocate", then(lambda env: setattr(env, "obs_space", env.action_space))),
    ("addresses", lw.Env, "step", then(lambda env: env.__dict__.update(obs=env.obs.clone()))),
    ("getters", lw.Env, "_given", lambda method: lambda self, values, out: values),
    ("time", lw.Env, "_allocate", then(lambda env: setattr(env, "timestep", 1.5 * env.timestep))),
    ("round_trip", lw.Env, "_unpack_counters", nothing),
    ("restoring", MujocoEngine, "_set_integration", nothing),
    ("masked_restoring", lw.Env, "set_state", lambda method: lambda self, state, mask=None: method(self, state)),
    ("masked_getting", lw.Env, "get_state", lambda method: lambda self, out=None, mask=None: method(self, out)),
    ("set_state_shows", lw.Env, "_judge_state", nothing),
    ("purity", lw.Env, "_scratch_at", lambda method: lambda self, state: self.set_state(state) or self),
    ("determinism", lw.Env, "step", then(lambda env: env.reward.add_(1e-6 * next(counter)))),
    ("reset", lw.Env, "reset", then(lambda env: env.action.fill_(0.1))),
    ("masked_reset", lw.Env, "reset", lambda method: lambda self, mask=None: method(self)),
    ("rand_reset", lw.Env, "rand_reset", lambda method: lambda self, seed=None, mask=None: method(self, None, mask)),
    ("world_count", lw.Env, "rand_reset", then(lambda env: env.obs.add_(env.nworld))),
    ("saved_stream", lw.Env, "_unpack_counters", nothing),
    ("truncation", lw.Env, "step", then(lambda env: env.final_obs.copy_(env.obs))),
    ("truncation", lw.Env, "step", then(lambda env: env.terminated.copy_(env.done))),
    ("no_autoreset", lw.Env, "step", then(lambda env: env.done.zero_())),
    ("recording", Recorder, "__call__", skip_some),
    ("memory", lw.Env, "step", then(lambda env: leak.append(float(env.nworld)))),  # 32 bytes
    ("memory", lw.Env, "get_state", then(lambda env: env.__dict__.setdefault("kept", []).append(env.obs.clone()))),
    ("bad_state", MujocoEngine, "find_faults", nothing),
    ("bad_action", lw.Env, "_judge", lambda method: lambda self, mask, fault, action_fault, **how: method(
        self, mask, fault, self._no_fault, **how)),
    ("bad_warmstart", MujocoEngine, "__init__", then(keep_warm_start)),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "owner", "name", "wrap"), BREAKS, ids=[f"{b[0]}-{b[2]}" for b in BREAKS])
def test_every_check_can_fail(
    rule: str, owner: type, name: str, wrap: Callable[[Method], Method], monkeypatch: pytest.MonkeyPatch
) -> None:
    (check,) = (check for check in CHECKS if check.__name__ == f"check_{rule}")
    monkeypatch.setattr(owner, name, wrap(getattr(owner, name)))
    with pytest.raises(AssertionError, match=f"hopper on the mujoco engine breaks the rule '{rule}': "):
        check_task("hopper", engine="mujoco", steps=100, checks=[check])


def test_every_check_is_tried() -> None:
    rules = {f"check_{rule}" for rule, *_ in BREAKS}
    assert rules == {check.__name__ for check in CHECKS}
