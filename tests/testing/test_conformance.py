import pytest
from toy_engine import ToyEngine
from world_rules import CHECKS

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.testing import check_task, state_rules as state
from lyceum_warp.testing.fault_rules import check_not_finite
from lyceum_warp.testing.physics_rules import check_dynamics

EVERY_RULE = {
    "mujoco": ("hopper", "humanoid", "adroit_pen", "soft_ball"),
    "warp": ("hopper", "adroit_pen", "soft_ball"),
}
"""The tasks that pass every check on an engine. Together they use most features of models."""
OF_THE_TASK = tuple(check for check in CHECKS if check is not check_not_finite)
"""On the C engine, the other tasks pass these checks. A slow check, which hardly depends on the task, is missing."""
OF_THE_STATE = (
    state.check_addresses, state.check_restoring, state.check_purity, state.check_determinism,
    state.check_reset,
)  # fmt: skip
"""On the Warp engine, the other tasks pass only these checks, because this engine is slow on a CPU."""
PACKAGE = [name for name in lw.task_names() if find_task(name).__module__.startswith("lyceum_warp.tasks.")]


def options(task: str, engine: str) -> dict[str, int]:
    """Return the options of ``check_task``. They include fewer steps for the Warp engine, which is slow on a CPU."""
    every = task in EVERY_RULE[engine]
    if engine == "mujoco":
        return {"steps": 1000 if task == "hopper" else 300 if every else 100}
    if task == "hopper":
        return {"steps": 300}
    return {"steps": 100 if every else 40, "frame_skip": min(2, find_task(task).frame_skip)}


@pytest.mark.quick("mujoco-cartpole_swingup", "mujoco-reach", "warp-half_cheetah", "warp-point_mass")
@pytest.mark.parametrize(("engine", "task"), [(engine, task) for engine in EVERY_RULE for task in PACKAGE])
def test_task_passes_all_checks_of_check_task(task: str, engine: str) -> None:
    checks = CHECKS if task in EVERY_RULE[engine] else OF_THE_TASK if engine == "mujoco" else OF_THE_STATE
    report = check_task(task, engine=engine, checks=checks, **options(task, engine))
    assert list(report.seconds) == [check.__name__.removeprefix("check_") for check in checks]


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "engine"), [(task, engine) for engine in EVERY_RULE for task in PACKAGE if task not in EVERY_RULE[engine]]
)
def test_task_passes_the_quick_checks_of_check_task(task: str, engine: str) -> None:
    done = OF_THE_TASK if engine == "mujoco" else OF_THE_STATE
    checks = [check for check in CHECKS if check not in done]
    if engine == "warp" and ("rough" in task or "leap" in task):
        # on a height field, the C engine creates more contacts than MuJoCo Warp; in a hand's contacts, five iterations
        # of the solver do not converge
        checks.remove(check_dynamics)
    check_task(task, engine=engine, checks=checks, **options(task, engine))


@pytest.mark.quick("point_mass")
@pytest.mark.parametrize("task", ["hopper", "point_mass"])
def test_task_passes_check_task_on_a_third_engine(task: str) -> None:
    assert f"{task} on the toy engine" in str(check_task(task, engine=ToyEngine, steps=100, checks=CHECKS))
