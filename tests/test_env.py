"""The public face: what reaches the engine, what is refused, and environments in other processes."""

import copy
import multiprocessing
import pickle
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mujoco_warp
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.worlds import Worlds

PACKAGE = Path(lw.__file__).parent


def own_frames() -> list[tuple[str, str]]:
    """The files and functions of the package on the stack, outermost first."""
    frames = [(Path(frame.filename), frame.name) for frame in traceback.extract_stack()]
    return [(str(path.relative_to(PACKAGE)), name) for path, name in frames if path.is_relative_to(PACKAGE)]


class Spy:
    """Passes everything on, and keeps the stack of calls of ``step``."""

    def __init__(self, batch: Any) -> None:
        self.batch, self.stacks = batch, []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.batch, name)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        self.stacks.append(own_frames())
        return self.batch.step(*args, **kwargs)


def test_a_step_reaches_the_c_engine_through_two_functions() -> None:
    env = lw.make("hopper", nworld=2)
    env.engine.batch = spy = Spy(env.engine.batch)  # type: ignore[attr-defined]
    env.step()
    assert spy.stacks == [[("env.py", "step"), ("engines/c/mujoco_engine.py", "step")]]


def test_an_uncaptured_step_reaches_mujoco_warp_through_two_functions(monkeypatch: pytest.MonkeyPatch) -> None:
    env = lw.make("hopper", nworld=2, engine="warp", graphs=False)
    stacks, step = [], mujoco_warp.step

    def spy(*args: Any) -> None:
        stacks.append(own_frames())
        step(*args)

    monkeypatch.setattr(mujoco_warp, "step", spy)
    env.step()
    assert stacks == [[("env.py", "step"), ("engines/warp/warp_engine.py", "step")]] * env.task.frame_skip


def test_the_phases_of_a_step_are_one_list_in_order() -> None:
    names = {task: [p.name for p in Worlds.step_phases(lw.make(task).worlds)] for task in ("hopper", "reach")}
    assert names["reach"] == ["act", "physics", "judge", "restart", "refresh", "observe"]
    assert names["hopper"] == ["act", "physics", "judge", "restart", "observe"]  # it reads the state alone


def test_a_field_that_is_not_kept_is_refused_with_the_way_to_get_it() -> None:
    env = lw.make("hopper")
    size = env.state_space.size
    with pytest.raises(ValueError, match=r"does not keep the field 'site_xpos': make it with fields=\['site_xpos'\]"):
        env.field("site_xpos")
    assert env.state_space.size == size
    with pytest.raises(ValueError, match="there is no field 'site_xpoz': did you mean site_xpos"):
        env.field("site_xpoz")
    assert lw.make("reach", fields=["xpos"]).field("xpos").shape[2] == 3


def test_time_and_controls_are_always_kept() -> None:
    env = lw.make("hopper", nworld=2)
    env.step(torch.full((2, 3), 0.5))
    assert torch.equal(env.time, torch.full((2,), env.timestep))
    assert torch.equal(env.field("ctrl"), env.action)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_fields_beside_the_task_do_not_change_its_numbers(engine: str) -> None:
    plain, more = (lw.make("reach", nworld=3, engine=engine, fields=fields) for fields in ((), ("xpos", "cvel")))
    for env in (plain, more):
        env.rand_reset(1)
        for _ in range(3):
            env.step(torch.full_like(env.action, 0.3))
    assert torch.equal(plain.obs, more.obs)
    assert torch.equal(plain.reward, more.reward)


@pytest.mark.parametrize("spoil", [pickle.dumps, copy.copy, copy.deepcopy])
def test_an_environment_is_not_pickled_or_copied(spoil: Any) -> None:
    with pytest.raises(TypeError, match=r"cannot be pickled or copied: make it again .*env.replicate"):
        spoil(lw.make("hopper"))


def _use(env: lw.Env, connection: Connection) -> None:
    told = []
    for call in (env.step, env.reset, env.get_state):
        try:
            call()
        except RuntimeError as error:
            told.append(str(error))
    connection.send(told)


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_environment_in_a_forked_child_says_that_it_belongs_to_the_parent() -> None:
    env = lw.make("hopper", nworld=2)
    env.step()
    here, there = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=_use, args=(env, there))
    child.start()
    assert here.poll(60), "the child hangs"
    told = here.recv()
    child.join(60)
    assert child.exitcode == 0
    assert len(told) == 3
    assert all("made before the process was forked" in text and "'spawn'" in text for text in told)
    env.step()  # the parent's goes on
