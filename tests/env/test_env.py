import copy
import ctypes
import gc
import multiprocessing
import sys
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch

import lyceum_warp as lw


def test_error_of_an_unavailable_field_suggests_a_fix() -> None:
    env = lw.make("hopper")
    size = env.state_space.size
    with pytest.raises(
        ValueError, match=r"does not provide the field 'site_xpos': make the environment with fields=\['site_xpos'\]"
    ):
        env.field("site_xpos")
    assert env.state_space.size == size
    with pytest.raises(ValueError, match="there is no field 'site_xpoz': did you mean site_xpos"):
        env.field("site_xpoz")
    with pytest.raises(ValueError, match=r"there is no field 'body_masses': did you mean body_mass\b"):
        env.field("body_masses")
    assert lw.make("reach", fields=["xpos"]).field("xpos").shape[2] == 3


def test_time_and_controls_are_available_in_every_environment() -> None:
    env = lw.make("hopper", nworld=2)
    env.step(torch.full((2, 3), 0.5))
    assert torch.equal(env.time, torch.full((2,), env.timestep))
    assert torch.equal(env.field("ctrl"), env.action)


def test_arrays_of_the_model_refuse_edits_and_a_copy_accepts_them() -> None:
    model = lw.make("hopper").model
    for array in (model.body_mass, model.opt.gravity):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 3.0
    other = copy.copy(model)
    other.body_mass[1] = 3.0
    assert model.body_mass[1] != 3.0


def in_a_forked_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a forked child process, and return its result."""
    here, there = multiprocessing.Pipe()
    fork = multiprocessing.get_context("fork")
    child = fork.Process(target=lambda: there.send(function(*arguments)))
    child.start()
    hangs = not here.poll(60)
    if hangs:
        child.kill()
    result = None if hangs else here.recv()
    child.join(60)
    assert not hangs and child.exitcode == 0
    return result


def messages_of_every_use(env: lw.Env, plan: lw.MPPI, loop: lw.OpenLoop, state: torch.Tensor) -> list[str]:
    messages = []
    for call in (env.step, env.reset, env.get_state, lambda: env.engine.step(1), loop.run, lambda: plan(state)):
        try:
            call()
        except RuntimeError as error:
            messages.append(str(error))
    return messages


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_environment_in_a_forked_child_raises_an_error() -> None:
    env = lw.make("hopper", nworld=64)
    env.step()
    plan, loop = lw.MPPI("hopper", samples=64, horizon=4), lw.OpenLoop(lw.make("hopper", nworld=64, autoreset=False), 4)
    plan(env.get_state()[0])
    loop.run()
    messages = in_a_forked_child(messages_of_every_use, env, plan, loop, env.get_state()[0])
    assert len(messages) == 6
    assert all("made before the process was forked" in text and "'spawn'" in text for text in messages)
    env.step()


def faults_of_another_environment() -> int:
    gc.collect()
    env = lw.make("hopper", nworld=64)
    env.step()
    return int(env.done_reason.sum())


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_engine_of_a_deleted_environment_is_freed_before_a_fork(engine: str) -> None:
    gc.disable()
    try:
        env = lw.make("hopper", nworld=64, engine=engine)
        env.get_reward(state := env.get_state(), env.action, state)
        env.step()
        parts = [weakref.ref(part) for part in (env.worlds, env.engine, env.task)]
        del env
        assert [part() for part in parts] == [None, None, None]
        assert in_a_forked_child(faults_of_another_environment) == 0
    finally:
        gc.enable()


class MallocUse(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = [(name, ctypes.c_size_t) for name in names]


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="only glibc counts the bytes in use")
def test_environments_that_are_made_and_dropped_leave_no_memory_in_use() -> None:
    """The resident memory still grows, because glibc keeps freed memory."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = MallocUse
    config = lw.NPGConfig(samples=16, hidden=(4,), value_hidden=(4,), mean_every=0)

    def in_use() -> tuple[int, int]:
        gc.collect()
        use = mallinfo2()
        return use.uordblks + use.hblkhd, sys.getallocatedblocks()

    def make_and_drop(rounds: int) -> None:
        for _ in range(rounds):
            for engine in ("mujoco", "warp"):
                lw.make("point_mass", nworld=2, engine=engine).step()
            plan = lw.MPPI("point_mass", samples=4, horizon=4)
            plan(lw.make("point_mass", autoreset=False).get_state()[0])
            next(lw.NPG(lw.make("point_mass", nworld=2, horizon=8), config=config))

    make_and_drop(6)  # fill the caches
    bytes_before, blocks_before = in_use()
    make_and_drop(rounds := 8)
    bytes_after, blocks_after = in_use()
    # measured: 1 kB and 20 blocks, and fewer after more rounds; one kept array of each environment takes 10 kB
    assert bytes_after - bytes_before < 5000 * rounds
    assert blocks_after - blocks_before < 100 * rounds


def test_follow_copies_the_parameters_of_another_environment() -> None:
    first = lw.make("hopper", nworld=2, healthy_reward=3.0)
    second = first.replicate(nworld=4, ctrl_cost_weight=0.5)
    second.follow(first)
    assert second.task.params == first.task.params
    with pytest.raises(ValueError, match="other must be of type Env, an environment of the same task, not int 3"):
        second.follow(3)  # type: ignore[arg-type]


def test_set_params_with_an_option_raises_an_error_that_suggests_replicate() -> None:
    with pytest.raises(ValueError, match=r"'nworld' is an option, not a parameter: .*env.replicate\(nworld=...\)"):
        lw.make("hopper").set_params(nworld=3)


@pytest.mark.parametrize("name", ["obs", "reward", "eval", "terminated", "action"])
def test_getter_copies_a_buffer_or_writes_into_out(name: str) -> None:
    env = lw.make("hopper", nworld=2, seed=0)
    env.step(torch.ones(2, 3))
    getter, buffer = getattr(env, f"get_{name}"), getattr(env, name)
    value, out = getter(), ~buffer if buffer.dtype == torch.bool else buffer + 1
    assert torch.equal(value, buffer) and value.data_ptr() != buffer.data_ptr()
    assert getter(out=out) is out and torch.equal(out, buffer)
    if name in ("obs", "eval", "terminated"):
        assert torch.equal(getter(env.get_state(), out=torch.zeros_like(out)), buffer)
    env.set_action(torch.zeros(2, 3))
    assert not env.action.any()


def test_get_state_with_a_mask_writes_only_the_rows_of_these_worlds() -> None:
    env = lw.make("hopper", nworld=3, seed=0)
    state, mask = env.get_state(), torch.tensor([True, False, True])
    out = torch.full_like(state, -7.0)
    assert env.get_state(out=out, mask=mask) is out
    assert torch.equal(out, torch.where(mask[:, None], state, -7.0))


def test_get_state_with_a_mask_but_without_out_raises_an_error() -> None:
    env = lw.make("hopper", nworld=2)
    with pytest.raises(ValueError, match="pass the tensor as out="):
        env.get_state(mask=torch.tensor([True, False]))
