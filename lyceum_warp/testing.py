"""The rules that hold for every task on every engine, as checks: run them on your own with ``check_task``.

Each check is one rule. It takes the environments under test, fails with an AssertionError that names the task,
the engine, the rule and the values, and leaves the environments usable for the next.
"""

import contextlib
import dataclasses
import gc
import logging
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.engines import EngineFactory, torch_view
from lyceum_warp.env import Env
from lyceum_warp.kernels.faults import FAULTS, Done
from lyceum_warp.task import Task

log = logging.getLogger(__name__)

OUTCOMES = (
    "obs", "final_obs", "reward", "eval", "terminated", "truncated", "success", "done", "done_reason",
)  # fmt: skip
"""The buffers that a step fills."""

_SETTINGS = ("horizon", "autoreset", "record")
_COUNTERS = ("step", "key", "episode")
_SHORT = 8  # steps of a check that needs only a few
_PYTHON_BYTES = 16_384  # tracemalloc's tolerance: interned numbers, caches of the interpreter


@dataclasses.dataclass
class Context:
    """What a check works on: two environments made alike, and the choices they were made with."""

    a: Env
    b: Env
    make: Callable[..., Env]
    """Makes another environment with the same options, but for those that are given."""
    steps: int
    """Steps of the checks that look at a long run."""
    seed: int
    task: str
    engine: str
    rule: str = ""
    """The rule that is being checked."""
    recordings: dict[tuple[object, ...], dict[Any, Any]] = dataclasses.field(default_factory=dict)
    """Recorded steps, by the environment and the settings that they hold."""

    def fail(self, problem: str) -> None:
        """Raise the AssertionError for a problem."""
        raise AssertionError(f"{self.task} on the {self.engine} engine breaks the rule {self.rule!r}: {problem}")

    def that(self, holds: bool | torch.Tensor, problem: str) -> None:
        """Fail unless something holds."""
        if not bool(holds):
            self.fail(problem)

    def equal(self, found: torch.Tensor, wanted: torch.Tensor, what: str) -> None:
        """Fail unless two tensors have the same shape, type and values to the bit (not-a-number equals itself)."""
        if found.shape != wanted.shape or found.dtype != wanted.dtype:
            self.fail(f"{what}: {found.dtype} {tuple(found.shape)} instead of {wanted.dtype} {tuple(wanted.shape)}")
        differ = ~((found == wanted) | ((found != found) & (wanted != wanted)))
        if differ.any():
            first = tuple(differ.nonzero()[0].tolist())
            self.fail(
                f"{what}: {int(differ.sum())} of {differ.numel()} values differ, the first at {first}: "
                f"{found[first].item()!r} instead of {wanted[first].item()!r}"
            )

    def restart(self, seed: int | None = None) -> None:
        """Put both environments into the same random initial states."""
        for env in (self.a, self.b):
            env.rand_reset(self.seed if seed is None else seed)

    def actions(self, steps: int, salt: int = 0) -> torch.Tensor:
        """Random actions within their bounds (-1 to 1 where there are none), (steps, nworld, nu)."""
        env = self.a
        assert env.action_space.low is not None and env.action_space.high is not None
        low = torch.as_tensor(np.where(np.isfinite(env.action_space.low), env.action_space.low, -1.0))
        high = torch.as_tensor(np.where(np.isfinite(env.action_space.high), env.action_space.high, 1.0))
        generator = torch.Generator().manual_seed(self.seed + 1000 * salt + 1)
        draws = torch.rand(steps, *env.action.shape, generator=generator)
        return (low + draws * (high - low)).to(env.action)

    def run(self, env: Env, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """Step through actions and collect what every step gave, (steps, nworld, ...)."""
        record: dict[str, list[torch.Tensor]] = {name: [] for name in ("state", *OUTCOMES)}
        for action in actions:
            env.step(action)
            record["state"].append(env.get_state())
            for name in OUTCOMES:
                record[name].append(getattr(env, name).clone())
        return {name: torch.stack(values) for name, values in record.items()}

    def same_runs(self, found: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor], what: str) -> None:
        """Fail unless two runs are the same to the bit."""
        for name in wanted:
            self.equal(found[name], wanted[name], f"{name} {what} (step, world, ...)")

    @contextlib.contextmanager
    def changed(self, *envs: Env, **options: Any) -> Iterator[None]:
        """For a while, give environments another ``horizon``, ``autoreset`` or ``record``.

        A recorded step holds these, so that each setting has its own recordings.
        """
        kept = [(env.horizon, env.autoreset, env._record.enabled) for env in envs]
        try:
            for env, values in zip(envs, kept, strict=True):
                chosen = [options.get(name, value) for name, value in zip(_SETTINGS, values, strict=True)]
                self._set(env, *chosen)
            yield
        finally:
            for env, values in zip(envs, kept, strict=True):
                self._set(env, *values)

    def _set(self, env: Env, horizon: int, autoreset: bool, record: bool) -> None:
        self.recordings[id(env), env.horizon, env.autoreset] = env._record._graphs
        env.horizon, env.autoreset, env._record.enabled = horizon, autoreset, record
        env._record._graphs = self.recordings.get((id(env), horizon, autoreset), {})

    def buffers(self, env: Env) -> dict[str, torch.Tensor]:
        """Copies of everything that an environment shows."""
        shown = {name: getattr(env, name).clone() for name in (*OUTCOMES, "action", "time")}
        fields = {f"field {name}": torch_view(array).clone() for name, array in env.engine.arrays.items()}
        return shown | fields | {"state": env.get_state()}

    def finite(self, env: Env, when: str) -> None:
        """Fail unless the state and everything computed from it are finite."""
        for name, values in {"state": env.get_state(), **{k: getattr(env, k) for k in OUTCOMES}}.items():
            self.that(torch.isfinite(values).all(), f"{name} is not finite {when}: {values}")


# what the buffers are


def check_spaces(ctx: Context) -> None:
    """Every space agrees with its buffer in shape and type, its parts cover it, and bounds are ordered."""
    env = ctx.a
    pairs = {
        "obs": (env.obs_space, env.obs), "action": (env.action_space, env.action),
        "reward": (env.reward_space, env.reward), "eval": (env.eval_space, env.eval),
        "state": (env.state_space, env.get_state()), "final_obs": (env.obs_space, env.final_obs),
    }  # fmt: skip
    for name, (space, buffer) in pairs.items():
        ctx.that(
            buffer.shape == (env.nworld, *space.shape) and buffer.dtype == space.dtype,
            f"{name} is {buffer.dtype} {tuple(buffer.shape)}, its space {space.dtype} {space.shape}",
        )
        ends = [0, *(part.stop for part in space.parts.values())]
        starts = [part.start for part in space.parts.values()]
        ctx.that(starts == ends[:-1], f"the parts of the {name} space leave gaps: {dict(space.parts)}")
        if space.low is not None and space.high is not None:
            ctx.that(space.low.shape == space.high.shape == space.shape, f"bounds of {name} have another shape")
            ctx.that(bool((space.low <= space.high).all()), f"bounds of {name} cross: {space.low}, {space.high}")
    for name in ("terminated", "truncated", "success", "done"):
        ctx.that(getattr(env, name).dtype == torch.bool, f"{name} is {getattr(env, name).dtype}")
    for name in (*OUTCOMES, "action", "time"):
        device = getattr(env, name).device
        ctx.that(device.type == ("cpu" if env.device.is_cpu else "cuda"), f"{name} lies on {device}")
    for part in ("time", "qpos", "qvel", *_COUNTERS):
        ctx.that(part in env.state_space.parts, f"the state has no {part}; it has {list(env.state_space.parts)}")


def check_observation_size(ctx: Context) -> None:
    """``observe`` writes all of the declared observation and nothing behind it."""
    env, nobs = ctx.a, ctx.a.obs_space.size
    wide = wp.full((env.nworld, nobs + 64), np.nan, dtype=float, device=env.device)
    wp.launch(env.task.kernels.look, env.nworld, [env._everyone, env._after, env._params, wide], device=env.device)
    written = ~torch.isnan(torch_view(wide))
    ctx.that(
        not written[:, nobs:].any(),
        f"observe writes up to place {int(written.nonzero()[:, 1].max())}, obs declares {nobs} numbers",
    )
    missing = (~written[:, :nobs]).nonzero()[:, 1].unique().tolist()
    ctx.that(not missing, f"observe leaves places {missing} of {nobs} unwritten, or they are not-a-number")


def check_addresses(ctx: Context) -> None:
    """Every buffer stays the same object at the same address, over steps, resets and setting states."""
    env = ctx.a
    ctx.restart()
    names = (*OUTCOMES, "action", "time")
    before = {name: (id(getattr(env, name)), getattr(env, name).data_ptr()) for name in names}
    fields = {name: array.ptr for name, array in env.engine.arrays.items()}
    state = env.get_state()
    for action in ctx.actions(_SHORT):
        env.step(action)
    env.reset()
    env.rand_reset()
    env.set_state(state)
    for name in names:
        ctx.that(id(getattr(env, name)) == before[name][0], f"env.{name} has become another object")
        ctx.that(getattr(env, name).data_ptr() == before[name][1], f"env.{name} has moved")
    for name, pointer in fields.items():
        ctx.that(env.engine.arrays[name].ptr == pointer, f"the field {name} has moved")


def check_getters(ctx: Context) -> None:
    """``get_x(out=)`` writes what ``get_x()`` returns, which is a copy of ``env.x``."""
    env = ctx.a
    ctx.restart()
    for action in ctx.actions(3):
        env.step(action)
    for name in ("obs", "reward", "eval", "terminated", "action", "state"):
        getter = getattr(env, f"get_{name}")
        value = getter()
        out = torch.zeros_like(value) if value.dtype == torch.bool else torch.full_like(value, 7)
        returned = getter(out=out)
        ctx.that(returned is out, f"get_{name}(out=) does not return out")
        ctx.equal(out, value, f"get_{name}(out=)")
        if name != "state":
            ctx.equal(value, getattr(env, name), f"get_{name}()")
            ctx.that(value.data_ptr() != getattr(env, name).data_ptr(), f"get_{name}() is no copy")
    state = env.get_state()
    for name in ("obs", "eval", "terminated"):
        getter = getattr(env, f"get_{name}")
        out = torch.zeros_like(getter())
        ctx.equal(getter(state, out=out), getter(state), f"get_{name}(state, out=)")
    action = ctx.actions(1, 1)[0]
    env.set_action(action)
    ctx.equal(env.action, action, "the action after set_action")


def check_time(ctx: Context) -> None:
    """``env.time`` is 0 after a reset, grows by ``env.timestep`` a step, and asking for it changes nothing."""
    env = ctx.a
    with ctx.changed(env, autoreset=False, horizon=0):
        for reset in (env.reset, env.rand_reset):
            reset()
            ctx.that((env.time == 0).all(), f"time is {env.time.tolist()} after {reset.__name__}")
            for i, action in enumerate(ctx.actions(_SHORT), 1):
                env.step(action)
                wanted = torch.full_like(env.time, i * env.timestep)
                ctx.that(
                    torch.allclose(env.time, wanted, rtol=1e-5) or (env.done_reason & int(FAULTS)).any(),
                    f"time is {env.time.tolist()} after {i} steps of {env.timestep} s",
                )
                again = env.time.clone()
                env.get_state()
                ctx.equal(env.time, again, "time, asked for twice")


# the state


def check_round_trip(ctx: Context) -> None:
    """Getting a state, setting it and getting it again gives the same numbers."""
    env = ctx.a
    ctx.restart()
    ctx.run(env, ctx.actions(5))
    state = env.get_state()
    ctx.run(env, ctx.actions(_SHORT, 1))
    env.set_state(state)
    ctx.equal(env.get_state(), state, "the state after set_state (world, column)")
    out = torch.empty_like(state)
    ctx.equal(env.get_state(out=out), state, "the state after set_state, with out= (world, column)")


def check_restoring(ctx: Context) -> None:
    """Steps after setting a state equal those that followed it before, in the same worlds or in others."""
    a, b = ctx.a, ctx.b
    ctx.restart()
    ctx.run(a, ctx.actions(7))
    state, actions = a.get_state(), ctx.actions(2 * _SHORT, 1)
    first = ctx.run(a, actions)
    a.set_state(state)
    ctx.same_runs(ctx.run(a, actions), first, "after restoring")
    ctx.run(b, ctx.actions(3, 2))
    b.set_state(state)
    ctx.same_runs(ctx.run(b, actions), first, "after restoring in another environment")


def check_masked_restoring(ctx: Context) -> None:
    """Setting the states of some worlds only leaves the others as they are, to the bit."""
    a, b = ctx.a, ctx.b
    ctx.restart()
    mask = torch.arange(a.nworld, device=a.action.device) % 2 == 0
    state, early, late = a.get_state(), ctx.actions(_SHORT), ctx.actions(_SHORT, 1)
    first = ctx.run(a, early)
    ctx.run(b, early)
    before = ctx.buffers(a)
    a.set_state(state, mask)
    for name, values in ctx.buffers(a).items():
        ctx.equal(values[~mask], before[name][~mask], f"{name} of the worlds that were not set (world, ...)")
    ctx.equal(a.get_state()[mask], state[mask], "the state of the worlds that were set")
    found = ctx.run(a, torch.where(mask[None, :, None], early, late))
    undisturbed = ctx.run(b, torch.where(mask[None, :, None], early, late))
    for name in found:
        ctx.equal(found[name][:, mask], first[name][:, mask], f"{name} of the restored worlds")
        ctx.equal(found[name][:, ~mask], undisturbed[name][:, ~mask], f"{name} of the other worlds")


def check_set_state_shows(ctx: Context) -> None:
    """After ``set_state`` every getter tells of the state that was set."""
    a, b = ctx.a, ctx.b
    has_evaluate = a.task.functions["evaluate"] is not None
    with ctx.changed(a, autoreset=False, horizon=0):
        ctx.restart()
        for action in ctx.actions(10):
            a.step(action)
            state, shown = a.get_state(), ctx.buffers(a)
            b.set_state(state)
            found = ctx.buffers(b)
            for name in shown:
                if name in ("obs", "success", "time", "state") or name.startswith("field "):
                    ctx.equal(found[name], shown[name], f"{name} after set_state")
            ctx.equal(b.final_obs, a.obs, "final_obs after set_state")
            if has_evaluate:
                ctx.equal(b.eval, a.eval, "eval after set_state")
            ctx.that((b.reward == 0).all(), f"the reward after set_state is {b.reward.tolist()}")
            # in a, an end stays set once it has come
            ctx.that((a.terminated | ~b.terminated).all(), "terminated after set_state is set where it was not")
            ctx.equal(b.terminated, a.get_terminated(state), "terminated after set_state")


def check_purity(ctx: Context) -> None:
    """Functions of old arguments give what the live step gave, whenever they are asked, and change nothing."""
    env = ctx.a
    has_evaluate = env.task.functions["evaluate"] is not None
    with ctx.changed(env, autoreset=False, horizon=0):
        ctx.restart()
        actions = ctx.actions(6)
        states = [env.get_state()]
        live = ctx.run(env, actions)
        states += list(live["state"])
        ended = torch.zeros_like(env.done)
        for pause in range(2):
            for i, action in enumerate(actions):
                before = ctx.buffers(env)
                fine = (live["done_reason"][i] & int(FAULTS)) == 0
                reward = env.get_reward(states[i], action, states[i + 1])
                ctx.equal(reward[fine], live["reward"][i][fine], f"get_reward of step {i}, {20 * pause} steps later")
                state = states[i + 1]
                ctx.equal(env.get_obs(state), live["obs"][i], f"get_obs of step {i}")
                if has_evaluate:
                    ctx.equal(env.get_eval(state)[fine], live["eval"][i][fine], f"get_eval of step {i}")
                ended = env.get_terminated(state) | (ended if i else torch.zeros_like(ended))
                ctx.equal(ended[fine], live["terminated"][i][fine], f"get_terminated up to step {i}")
                for name, values in ctx.buffers(env).items():
                    ctx.equal(values, before[name], f"{name} of the live worlds after asking about old ones")
            ctx.run(env, ctx.actions(20, 1))


def check_determinism(ctx: Context) -> None:
    """Two environments made alike and given the same actions stay the same to the bit, through all resets."""
    ctx.restart()
    for i, action in enumerate(ctx.actions(ctx.steps)):
        ctx.a.step(action)
        ctx.b.step(action)
        for name in ("reward", "eval", "done_reason", "obs", "final_obs"):
            ctx.equal(getattr(ctx.b, name), getattr(ctx.a, name), f"{name} at step {i}")
        if i % 10 == 0 or i == ctx.steps - 1:
            ctx.equal(ctx.b.get_state(), ctx.a.get_state(), f"the state at step {i}")
    ctx.finite(ctx.a, f"after {ctx.steps} random steps")


# resets and randomness


def _physics(env: Env, state: torch.Tensor) -> torch.Tensor:
    counters = [env.state_space.parts[name].start for name in _COUNTERS]
    return torch.stack([column for i, column in enumerate(state.T) if i not in counters], dim=1)


def check_reset(ctx: Context) -> None:
    """``reset`` leads to one and the same state whatever happened before, with zero actions."""
    env = ctx.a
    env.reset()
    state, obs = _physics(env, env.get_state()), env.obs.clone()
    ctx.equal(obs, obs[:1].expand_as(obs).contiguous(), "the worlds' observations after reset") if not any(
        isinstance(value, np.ndarray) for value in env.task.params.values()
    ) else None
    for action in ctx.actions(100):
        env.step(action)
    env.reset()
    ctx.equal(_physics(env, env.get_state()), state, "the state after reset, without its counters")
    ctx.equal(env.obs, obs, "obs after reset")
    ctx.equal(env.final_obs, obs, "final_obs after reset")
    ctx.that((env.action == 0).all(), f"the actions after reset are {env.action.tolist()}")
    ctx.that((env.reward == 0).all(), f"the rewards after reset are {env.reward.tolist()}")
    ctx.equal(env.get_obs(env.get_state()), obs, "get_obs of the state after reset")


def check_masked_reset(ctx: Context) -> None:
    """Resetting some worlds only leaves the others as they are, to the bit."""
    env = ctx.a
    mask = torch.arange(env.nworld, device=env.action.device) % 2 == 1
    for reset in (env.reset, env.rand_reset):
        ctx.restart()
        ctx.run(env, ctx.actions(_SHORT))
        before = ctx.buffers(env)
        reset(mask=mask)
        for name, values in ctx.buffers(env).items():
            ctx.equal(values[~mask], before[name][~mask], f"{name} of the worlds left out of {reset.__name__}")
        ctx.that((env.time[mask] == 0).all() and (env.action[mask] == 0).all(), f"{reset.__name__} left out a world")


def check_rand_reset(ctx: Context) -> None:
    """``rand_reset(seed)`` can be repeated; draws, worlds and seeds differ; actions are zero."""
    a, b = ctx.a, ctx.b
    ctx.run(a, ctx.actions(5))
    ctx.restart()
    state = a.get_state()
    ctx.equal(b.get_state(), state, "the state after rand_reset with the same seed")
    ctx.equal(b.obs, a.obs, "obs after rand_reset with the same seed")
    ctx.that((a.action == 0).all(), f"the actions after rand_reset are {a.action.tolist()}")
    a.rand_reset()
    second = a.get_state()
    b.rand_reset()
    ctx.equal(b.get_state(), second, "the second draw")
    a.rand_reset(ctx.seed + 1)
    other = a.get_state()
    if a.task.functions["randomize"] is not None:
        first = _physics(a, state)
        ctx.that((_physics(a, second) != first).any(dim=1).all(), "two consecutive draws are the same")
        ctx.that((_physics(a, other) != first).any(dim=1).all(), "two seeds give the same worlds")
        if a.nworld > 1:
            ctx.that((first[1:] != first[:1]).any(dim=1).all(), "worlds of one draw are the same")
    a.rand_reset(ctx.seed)
    ctx.equal(a.get_state(), state, "the state after the seed was given again")


def check_world_count(ctx: Context) -> None:
    """A seed gives world i the same initial state however many worlds there are."""
    n = ctx.a.nworld
    doubled = {k: np.concatenate([v, v]) for k, v in ctx.a.task.params.items() if isinstance(v, np.ndarray)}
    more = ctx.make(nworld=2 * n, seed=ctx.seed, **doubled)
    ctx.restart()
    ctx.equal(more.get_state()[:n], ctx.a.get_state(), f"the states of {n} of {2 * n} worlds")
    ctx.equal(more.obs[:n], ctx.a.obs, f"the observations of {n} of {2 * n} worlds")


def check_saved_stream(ctx: Context) -> None:
    """A saved state goes on with its own random stream: later automatic resets lead to the same states."""
    a, b = ctx.a, ctx.b
    with ctx.changed(a, b, horizon=3):
        ctx.restart()
        ctx.run(a, ctx.actions(4))
        state, actions = a.get_state(), ctx.actions(8, 1)
        first = ctx.run(a, actions)
        b.rand_reset(ctx.seed + 5)
        ctx.run(b, actions[:2])
        b.set_state(state)
        ctx.same_runs(ctx.run(b, actions), first, "after restoring, through automatic resets")


# the end of an episode


def _check_flags(ctx: Context, env: Env) -> None:
    reason = env.done_reason
    ctx.equal(env.truncated, (reason & int(Done.TRUNCATED)) != 0, "truncated against done_reason")
    ctx.equal(env.terminated, (reason & ~int(Done.TRUNCATED)) != 0, "terminated against done_reason")
    ctx.equal(env.done, env.terminated | env.truncated, "done against terminated and truncated")


def check_truncation(ctx: Context) -> None:
    """At the horizon an episode is truncated; ``final_obs`` is its last observation, ``obs`` the first of the next.

    A truncated episode is not terminated on that account, and worlds that go on have both observations the same.
    """
    a, b, horizon = ctx.a, ctx.b, 4
    with ctx.changed(a, horizon=horizon, autoreset=True), ctx.changed(b, horizon=horizon, autoreset=False):
        ctx.restart()
        steps = torch.zeros_like(a.done_reason)
        alive = torch.ones_like(a.done)
        for action in ctx.actions(2 * horizon + 1):
            a.step(action)
            b.step(action)
            steps += 1
            _check_flags(ctx, a)
            ctx.equal(a.truncated, steps >= horizon, f"truncated after {steps.tolist()} steps of an episode")
            # until its first end, a world without automatic resets has the same life
            ctx.equal(a.final_obs[alive], b.obs[alive], "final_obs against obs without automatic resets")
            ctx.equal(a.reward[alive], b.reward[alive], "reward against the one without automatic resets")
            ctx.equal(a.terminated[alive], b.terminated[alive], "terminated with and without automatic resets")
            alive &= ~a.done
            ctx.equal(a.final_obs[~a.done], a.obs[~a.done], "final_obs of worlds that go on")
            ctx.equal(a.get_obs(a.get_state()), a.obs, "obs against the state, after automatic resets")
            ctx.that((a.time[a.done] == 0).all(), f"time is {a.time.tolist()} where done is {a.done.tolist()}")
            count = a.get_state()[:, a.state_space.parts["step"]].squeeze(1)
            steps[a.done] = 0
            ctx.equal(count, steps.to(count.dtype), "the state's step counter")


def check_no_autoreset(ctx: Context) -> None:
    """Without automatic resets ``done`` stays set, the world steps on, and ``final_obs`` equals ``obs``."""
    env, horizon = ctx.a, 3
    with ctx.changed(env, horizon=horizon, autoreset=False):
        ctx.restart()
        ended = torch.zeros_like(env.done)
        for i, action in enumerate(ctx.actions(3 * horizon), 1):
            env.step(action)
            _check_flags(ctx, env)
            ctx.that((env.done | ~ended).all(), f"done was {ended.tolist()} and is {env.done.tolist()}")
            ended |= env.done
            ctx.that(i < horizon or env.truncated.all(), f"truncated is {env.truncated.tolist()} after {i} steps")
            if not (env.done_reason & int(FAULTS)).any():
                ctx.that((env.time > (i - 0.5) * env.timestep).all(), f"time is {env.time.tolist()} after {i} steps")
                ctx.equal(env.final_obs, env.obs, "final_obs without automatic resets")
        mask = torch.zeros_like(env.done)
        mask[0] = True
        env.rand_reset(mask=mask)
        ctx.that(not env.truncated[0] and env.truncated[1:].all(), "a masked reset did not clear just its world's end")


# how it runs


def check_recording(ctx: Context) -> None:
    """A recorded step gives the same as an unrecorded one, to the bit, resets included."""
    a, b, n = ctx.a, ctx.b, 20
    with ctx.changed(a, horizon=6, record=True), ctx.changed(b, horizon=6, record=False):
        ctx.restart()
        actions = ctx.actions(n)
        ctx.same_runs(ctx.run(b, actions), ctx.run(a, actions), "unrecorded")
        for _ in range(3):
            a.rand_reset(ctx.seed)
            b.rand_reset(ctx.seed)
            ctx.equal(b.get_state(), a.get_state(), "the state after an unrecorded rand_reset")


def _memory(device: wp.Device) -> dict[str, int]:
    gc.collect()
    found = {"Python bytes": tracemalloc.get_traced_memory()[0]}
    # by type: isinstance would wake lazily loaded modules
    found["arrays"] = sum(issubclass(type(thing), (wp.array, torch.Tensor)) for thing in gc.get_objects())
    if device.is_cuda:
        found["Warp bytes"] = wp.get_mempool_used_mem_current(device)
        found["torch bytes"] = torch.cuda.memory_allocated(wp.device_to_torch(device))
    return found


def check_memory(ctx: Context) -> None:
    """Steps, resets, getting and setting states allocate nothing that stays."""
    env = ctx.a
    ctx.restart()
    actions, state = ctx.actions(32), env.get_state()
    mask = torch.arange(env.nworld, device=env.action.device) % 2 == 0

    def steps(n: int) -> None:
        for i in range(n):
            env.step(actions[i % 32])
            if i % 16 == 0:
                env.get_state(out=state)
                env.rand_reset(mask=mask)
                env.set_state(state, mask)
                env.reset(mask)

    steps(64)
    tracing = tracemalloc.is_tracing()
    if not tracing:
        tracemalloc.start()
    try:
        steps(64)
        before = _memory(env.device)
        steps(ctx.steps)
        after = _memory(env.device)
    finally:
        if not tracing:
            tracemalloc.stop()
    for name in before:
        allowed = _PYTHON_BYTES if name == "Python bytes" else 0
        growth = after[name] - before[name]
        ctx.that(growth <= allowed, f"{growth} more {name} after {ctx.steps} steps")


# trouble


def _check_fault(ctx: Context, spoil: Callable[[Env, int], None], reason: Done, what: str) -> None:
    """Spoil one world of env a and compare with env b, which is left alone."""
    a, b, bad = ctx.a, ctx.b, ctx.a.nworld // 2
    ctx.restart()
    others = torch.arange(a.nworld, device=a.action.device) != bad
    for action in ctx.actions(5):
        a.step(action)
        b.step(action)
    good, counts, actions = a.obs[bad].clone(), a.fault_counts, ctx.actions(_SHORT, 1)
    for env in (a, b):
        env.action.copy_(actions[0])
    spoil(a, bad)
    a.step()
    b.step()
    found = Done(int(a.done_reason[bad]))
    ctx.that(reason in found, f"{what}: done_reason is {found!r}")
    ctx.that(a.terminated[bad] and a.done[bad], f"{what}: terminated is {a.terminated.tolist()}")
    ctx.that(a.reward[bad] == 0, f"{what}: the reward is {a.reward[bad].item()}")
    ctx.that(not a.success[bad], f"{what}: it counts as a success")
    ctx.that(torch.isfinite(a.eval[bad]), f"{what}: eval is {a.eval[bad].item()}")
    ctx.equal(a.final_obs[bad], good, f"{what}: final_obs against the last good observation")
    ctx.that(a.time[bad] == 0, f"{what}: the world was not reset, its time is {a.time[bad].item()}")
    assert reason.name is not None
    name = reason.name.lower()
    ctx.that(a.fault_counts[name] == counts[name] + 1, f"{what}: counted {counts} before, {a.fault_counts} after")
    ctx.finite(a, f"after {what}")
    for i, action in enumerate(actions[1:]):
        for key in OUTCOMES:
            ctx.equal(getattr(a, key)[others], getattr(b, key)[others], f"{what}: {key} of other worlds, step {i}")
        ctx.equal(a.get_state()[others], b.get_state()[others], f"{what}: the state of other worlds, step {i}")
        a.step(action)
        b.step(action)
        ctx.finite(a, f"{i + 1} steps after {what}")
        ctx.that(not int(a.done_reason[bad]) & int(FAULTS), f"{what}: the world is in trouble again")


def check_bad_state(ctx: Context) -> None:
    """A state that is not a number, infinite or absurd ends the episode of its world and touches no other."""
    for part, value in (("qpos", np.nan), ("qvel", np.nan), ("qvel", np.inf), ("qpos", 1e11), ("qvel", -1e11)):

        def spoil(env: Env, world: int, part: str = part, value: float = value) -> None:
            state = env.get_state()
            state[world, env.state_space.parts[part].start] = value
            env.set_state(state, torch.arange(env.nworld, device=state.device) == world, check=False)

        _check_fault(ctx, spoil, Done.NAN, f"{value} in {part}")


def check_bad_action(ctx: Context) -> None:
    """An action that is not finite counts as zero and ends the episode of its world; it touches no other."""
    for value in (np.nan, np.inf, -np.inf):

        def spoil(env: Env, world: int, value: float = value) -> None:
            env.action[world, 0] = value

        _check_fault(ctx, spoil, Done.ACTION, f"an action of {value}")


def check_bad_warmstart(ctx: Context) -> None:
    """A warm start that is not a number neither spoils other worlds nor outlives the reset of its own."""
    a, b, bad = ctx.a, ctx.b, 0
    if "qacc_warmstart" not in a.state_space.parts:
        return
    ctx.restart()
    state = a.get_state()
    state[bad, a.state_space.parts["qacc_warmstart"]] = np.nan
    a.set_state(state, check=False)
    for i, action in enumerate(ctx.actions(4)):
        a.step(action)
        b.step(action)
        if i == 0 and (a.done_reason[bad] & int(FAULTS)) == 0:
            # nothing touches anything in this state, so that the solver has not looked at it
            ctx.that(torch.isfinite(a.obs[bad]).all(), "the observation is not finite, and no fault was seen")
        ctx.that(i == 0 or not int(a.done_reason[bad]) & int(FAULTS), f"the world is in trouble again at step {i}")
        ctx.equal(a.get_state()[bad + 1 :], b.get_state()[bad + 1 :], f"the state of other worlds at step {i}")
    ctx.finite(a, "after a warm start that was not a number")


CHECKS: tuple[Callable[[Context], None], ...] = (
    check_spaces, check_observation_size, check_addresses, check_getters, check_time,
    check_round_trip, check_restoring, check_masked_restoring, check_set_state_shows, check_purity,
    check_determinism, check_reset, check_masked_reset, check_rand_reset, check_world_count, check_saved_stream,
    check_truncation, check_no_autoreset, check_recording, check_memory,
    check_bad_state, check_bad_action, check_bad_warmstart,
)  # fmt: skip
"""All checks, in the order in which ``check_task`` runs them."""


@dataclasses.dataclass
class Report:
    """What ``check_task`` has checked."""

    task: str
    engine: str
    device: str
    nworld: int
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """How long each check took, by its name."""

    def __str__(self) -> str:
        head = f"{self.task} on the {self.engine} engine ({self.device}, {self.nworld} worlds) keeps the rules:"
        return "\n".join([head, *(f"  {name:<20} {value:6.2f} s" for name, value in self.seconds.items())])


def check_task(
    task: str | type[Task],
    *,
    engine: str | EngineFactory = "auto",
    device: str | None = None,
    nworld: int = 4,
    steps: int = 1000,
    seed: int = 0,
    checks: Sequence[Callable[[Context], None]] = CHECKS,
    **options: Any,
) -> Report:
    """Check that a task keeps every rule of an environment on an engine.

    Args:
        task: Name of a task, a file with one, or its class.
        engine: As for ``make``; also an engine of your own.
        device: As for ``make``.
        nworld: Number of worlds, at least 2.
        steps: Steps of the long checks (determinism, memory).
        seed: Of the worlds and of the random actions.
        checks: Which rules to check, out of ``CHECKS``.
        options: Other options of ``make`` and parameters of the task.

    Returns:
        What was checked; print it.

    Raises:
        AssertionError: Rules are broken; the message names all of them.

    Example:
        >>> print(check_task("hopper", engine="mujoco"))
    """
    if nworld < 2:
        raise ValueError(f"the checks compare worlds with one another: nworld has to be at least 2, not {nworld}")

    def make(**changes: Any) -> Env:
        return Env(task, **{"nworld": nworld, "device": device, "engine": engine, "seed": seed, **options, **changes})

    a = make()
    ctx = Context(a, make(), make, steps, seed, a.task.name, a.engine.name)
    report = Report(ctx.task, ctx.engine, a.device.alias, nworld)
    broken = []
    for check in checks:
        ctx.rule = check.__name__.removeprefix("check_")
        start = time.perf_counter()
        try:
            check(ctx)
        except AssertionError as error:
            broken.append(str(error))
        report.seconds[ctx.rule] = time.perf_counter() - start
    if broken:
        raise AssertionError("\n".join(broken))
    log.info("%s", report)
    return report
