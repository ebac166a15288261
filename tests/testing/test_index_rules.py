import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task
from lyceum_warp.testing.index_rules import check_bounds


@wp.struct
class World:
    qpos: Row[float]
    count: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float
    late: int = 1000


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.count[0] = s0.count[0] + 1.0
    if s0.count[0] == float(p.late):
        s1.count[p.late] = 1.0


@wp.func
def root(s: World) -> float:
    return wp.sqrt(s.qpos[0])  # the robot also moves backwards


class Late(lw.Task):
    model, obs = "hopper.xml", {"x": 1}


def test_write_that_leaves_its_row_only_after_some_steps_breaks_the_rule_bounds() -> None:
    check_task(Late, engine="mujoco", nworld=2, steps=10, checks=[check_bounds])
    with pytest.raises(AssertionError, match="'bounds': advance of the task 'late' writes 4 numbers .* in step 2"):
        check_task(Late, engine="mujoco", nworld=2, steps=10, checks=[check_bounds], late=3)


def test_reward_that_is_not_a_number_breaks_the_rule_bounds() -> None:
    rooted = type("Rooted", (Late,), {"rewards": {"root": 1.0}})
    with pytest.raises(AssertionError, match="'bounds': .*REWARD"):
        check_task(rooted, engine="mujoco", nworld=2, steps=20, checks=[check_bounds])
