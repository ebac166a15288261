"""Every task of the package keeps the rules of an environment on both engines; so do some on a third, a toy."""

import pytest
from conftest import settle
from toy_engine import ToyEngine

import lyceum_warp as lw
from lyceum_warp.binding.registry import find_task
from lyceum_warp.testing import CHECKS, check_task

PACKAGE = [name for name in lw.task_names() if find_task(name).__module__.startswith("lyceum_warp.tasks.")]


@pytest.fixture(autouse=True)
def settled_again() -> None:
    """The rule about memory looks through all objects, and each engine loads kernels of its own."""
    settle()


@pytest.mark.parametrize("task", PACKAGE)
def test_a_task_keeps_the_rules_on_the_mujoco_engine(task: str) -> None:
    # a leak in a long run shows with any task, so one of them is run for long
    report = check_task(task, engine="mujoco", steps=1000 if task == "hopper" else 300)
    assert list(report.seconds) == [check.__name__.removeprefix("check_") for check in CHECKS]


@pytest.mark.parametrize("task", PACKAGE)
def test_a_task_keeps_the_rules_on_the_warp_engine(task: str) -> None:
    # on the CPU a step of this engine takes milliseconds: one task runs for long, with all its substeps
    if task == "hopper":
        check_task(task, engine="warp", steps=600)  # enough to notice a leak of one number a step
    else:
        check_task(task, engine="warp", steps=100, frame_skip=min(2, find_task(task).frame_skip))


@pytest.mark.parametrize("task", ["hopper", "point_mass", "humanoid"])
def test_a_task_keeps_the_rules_on_a_third_engine(task: str) -> None:
    assert f"{task} on the toy engine" in str(check_task(task, engine=ToyEngine, steps=200))
