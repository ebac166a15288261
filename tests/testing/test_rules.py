import itertools
from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np
import pytest
import warp as wp
from form_tasks import Gifted, Weighed
from full_task import Full, Settled
from world_rules import CHECKS

import lyceum_warp as lw
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.env import Worlds
from lyceum_warp.graphs.capture import Calls, Graphs, Phase
from lyceum_warp.testing import check_task

Function = Callable[..., Any]


def then(extra: Callable[[Any], object]) -> Callable[[Function], Function]:
    """Return a decorator that calls ``extra`` after each call of a method."""

    def wrap(method: Function) -> Function:
        def longer(self: Any, *args: Any, **kwargs: Any) -> Any:
            result = method(self, *args, **kwargs)
            extra(self)
            return result

        return longer

    return wrap


def nothing(method: Function) -> Function:
    return lambda *args, **kwargs: None


counter = itertools.count(1)


def skip_some_replays(method: Function) -> Function:
    def sequence(self: Graphs, phases: Iterable[Phase]) -> Calls:
        calls = method(self, phases)
        if not self.enabled:
            return calls
        return tuple(lambda call=call: call() if next(counter) % 10 else None for call in calls)

    return sequence


def without_action_faults(method: Function) -> Function:
    return lambda self, mask, fault, action_fault, **how: method(self, mask, fault, self._no_fault, **how)


def keep_warm_start(engine: MujocoEngine) -> None:
    warm = mujoco.mjtState.mjSTATE_WARMSTART.value
    start = mujoco.mj_stateSize(engine.model, mujoco.mjtState.mjSTATE_INTEGRATION.value & (warm - 1))
    engine._initial.numpy()[start : start + engine.model.nv] = np.nan


def narrow_positions(worlds: Worlds) -> None:
    worlds.after.qpos = worlds.before.qpos = worlds.after.qpos[:, :0]
    del worlds._copies["qpos"]


def spoil_rewards(env: lw.Env) -> None:
    env.reward[(env.done_reason & int(lw.Done.REWARD)) != 0] = np.inf


def count_steps_as_none(method: Function) -> Function:
    """Set the step counters to 0 during an observation."""

    def judge(self: Worlds, *args: Any, **kwargs: Any) -> None:
        kept = self.counters.step.numpy().copy()
        self.counters.step.zero_()
        method(self, *args, **kwargs)
        self.counters.step.assign(kept)

    return judge


def clear_all_but(kept: str) -> Callable[[Function], Function]:
    return lambda method: lambda self, mask, *names: method(self, mask, *(name for name in names if name != kept))


def in_every_world(method: Function) -> Function:
    def event(self: Worlds, kernel: wp.Kernel) -> None:
        self.restarting.zero_()
        method(self, kernel)

    return event


def only_after_resets(method: Function) -> Function:
    return lambda self, mask, names=None: method(self, mask) if names is None else None


def once_a_step(method: Function) -> Function:
    def phases(self: Worlds, substeps: int | None = None, **options: Any) -> list[Phase]:
        return [Phase("physics", lambda: self.engine.step(self.task.frame_skip), engine=True), method(self)[-1]]

    return phases


def from_the_default(engine: MujocoEngine) -> None:
    data, size = mujoco.MjData(engine.model), mujoco.mjtState.mjSTATE_INTEGRATION.value
    state = np.zeros(engine.integration_size)
    mujoco.mj_getState(engine.model, data, state, size)
    engine._initial.assign(state)


Break = tuple[str, Any, str, Callable[[Function], Function]]

BREAKS: list[Break] = [
    ("addresses", lw.Env, "step", then(lambda env: env.__dict__.update(obs=env.obs.clone()))),
    ("set_state_shows", Worlds, "unpack_state", nothing),
    ("restoring", MujocoEngine, "_set_integration", nothing),
    ("masked_restoring", lw.Env, "set_state", lambda method: lambda self, state, mask=None: method(self, state)),
    ("set_state_shows", Worlds, "_judge_state", nothing),
    ("purity", lw.Env, "_scratch_at", lambda method: lambda self, state: self.set_state(state) or self),
    ("determinism", lw.Env, "step", then(lambda env: env.reward.add_(1e-6 * next(counter)))),
    ("reset", lw.Env, "reset", then(lambda env: env.action.fill_(0.1))),
    ("masked_reset", lw.Env, "reset", lambda method: lambda self, mask=None: method(self)),
    ("rand_reset", lw.Env, "rand_reset", lambda method: lambda self, seed=None, mask=None: method(self, None, mask)),
    ("world_count", lw.Env, "rand_reset", then(lambda env: env.obs.add_(env.nworld))),
    ("truncation", lw.Env, "step", then(lambda env: env.final_obs.copy_(env.obs))),
    ("truncation", lw.Env, "step", then(lambda env: env.terminated.copy_(env.done))),
    ("graphs", Graphs, "sequence", skip_some_replays),
    ("bounds", lw.Env, "__init__", then(lambda env: narrow_positions(env.worlds))),
    ("bad_state", MujocoEngine, "find_faults", nothing),
    ("bad_action", Worlds, "_judge", without_action_faults),
    ("bad_warmstart", MujocoEngine, "__init__", then(keep_warm_start)),
    ("not_finite", lw.Env, "step", then(spoil_rewards)),
]
"""Each patch makes hopper violate one rule."""

FULL_BREAKS: list[Break] = [
    ("bad_state", lw.Env, "step", then(lambda env: env.final_obs_groups["critic"].copy_(env.obs_groups["critic"]))),
    ("noise", Worlds, "_judge_state", count_steps_as_none),
    ("metrics", Worlds, "_clear", clear_all_but("metrics")),
    ("success_steps", Worlds, "_clear", clear_all_but("success_steps")),
    ("events", Worlds, "_event", in_every_world),
    ("events", Worlds, "_mark_changes", nothing),
    ("events", MujocoEngine, "commit", only_after_resets),
    ("substep", Worlds, "physics_phases", once_a_step),
    ("lasting_memory", Worlds, "_clear", clear_all_but("lasting_memory")),
    ("inputs", MujocoEngine, "__init__", then(lambda engine: setattr(engine, "_inputs", []))),
    ("dynamics", Worlds, "_make_nominal", nothing),
    ("dynamics", MujocoEngine, "apply_model", nothing),
    ("keyframe", MujocoEngine, "__init__", then(from_the_default)),
    ("rejection", Worlds, "_redraw", nothing),
]

ALL_BREAKS = [
    *(("hopper", *broken) for broken in BREAKS),
    *((Full, *broken) for broken in FULL_BREAKS),
    (Settled, "settle", MujocoEngine, "settle", lambda method: lambda self, mask, nstep: method(self, mask, 0)),
]


@pytest.mark.parametrize(
    ("task", "rule", "owner", "name", "wrap"), ALL_BREAKS, ids=[f"{b[1]}-{b[3]}-{i}" for i, b in enumerate(ALL_BREAKS)]
)
def test_violated_rule_is_reported(
    task: str | type[lw.Task], rule: str, owner: Any, name: str, wrap: Callable[[Function], Function],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    (check,) = (check for check in CHECKS if check.__name__ == f"check_{rule}")
    monkeypatch.setattr(owner, name, wrap(getattr(owner, name)))
    with pytest.raises(AssertionError, match=rf"\w+ on the mujoco engine breaks the rule '{rule}': "):
        check_task(task, engine="mujoco", steps=100, checks=[check])


@pytest.mark.quick("Full")
@pytest.mark.parametrize("task", [Full, Settled])
def test_task_with_every_feature_passes_check_task(task: type[lw.Task]) -> None:
    check_task(task, engine="mujoco", steps=60, checks=CHECKS)


@pytest.mark.quick("Weighed-warp", "Gifted-mujoco", "Gifted-warp")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
@pytest.mark.parametrize("task", [Weighed, Gifted])
def test_check_task_accepts_tasks_that_observe_lasting_memory(task: type[lw.Task], engine: str) -> None:
    checks = [check for check in CHECKS if engine == "mujoco" or check.__name__ == "check_reset"]
    check_task(task, engine=engine, nworld=3, steps=60, frame_skip=1, checks=checks)


def test_task_with_every_feature_passes_on_the_warp_engine() -> None:
    rules = ("bad_action", "events", "inputs", "dynamics", "rejection")
    checks = [check for check in CHECKS if check.__name__.removeprefix("check_") in rules]
    check_task(Full, engine="warp", nworld=2, frame_skip=1, checks=checks)


def test_every_check_is_tested_with_code_that_violates_its_rule() -> None:
    rules = {f"check_{rule}" for _, rule, *_ in ALL_BREAKS}
    assert rules == {check.__name__ for check in CHECKS}


def test_all_violated_rules_are_reported_together(monkeypatch: pytest.MonkeyPatch) -> None:
    checks = [check for check in CHECKS if check.__name__ in ("check_reset", "check_rand_reset", "check_masked_reset")]
    monkeypatch.setattr(lw.Env, "reset", then(lambda env: env.action.fill_(0.1))(lw.Env.reset))
    with pytest.raises(AssertionError) as caught:
        check_task("hopper", engine="mujoco", checks=checks)
    assert [line.split("'")[1] for line in str(caught.value).splitlines()[::2]] == ["reset", "masked_reset"]


def test_check_task_with_one_world_or_zero_steps_raises_an_error() -> None:
    with pytest.raises(ValueError, match="compare worlds with one another: nworld must be at least 2, not 1"):
        check_task("hopper", nworld=1)
    with pytest.raises(ValueError, match="steps must be a whole number from 1 to .*, not -5"):
        check_task("hopper", steps=-5)
