import re
import sys
from typing import Any

import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task
from lyceum_warp.testing.index_rules import check_bounds

THIS = sys.modules[__name__]
ORDER = wp.constant(wp.vec3i(2, 1, 0))


@wp.struct
class World:
    time: float
    qpos: Row[float]  # 6 numbers
    xpos: Row[wp.vec3]  # 5 bodies
    xmat: Row[wp.mat33]
    ten_length: Row[float]  # empty
    count: Row[float] = lw.memory()
    kept: Row[wp.vec3] = lw.memory(2)
    more: Row[float] = lw.memory(9)  # space for the writes that are out of range


@wp.struct
class Params:
    where: int = 0
    table: wp.array2d[float] = [[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [8.0, 9.0, 10.0, 11.0]]
    gains: wp.vec3 = wp.vec3(1.0, 2.0, 3.0)


# correct functions with every construct that Warp supports


@wp.func
def size_of(row: Row[float]) -> int:
    return row.shape[0]


@wp.func
def size_of(s: World) -> int:  # noqa: F811
    return size_of(s.qpos)


@wp.func
def last(row: Any, scale: float = 2.0):
    return scale * row[len(row) - 1]


@wp.func
def both(s: World):
    return s.qpos[0], s.qpos[1]


def enclosing(helper: Any, offset: float) -> Any:
    @wp.func
    def enclosed(s: World) -> float:
        return helper(s.qpos) + wp.static(2.0 * offset)

    return enclosed


enclosed = enclosing(last, 0.25)


@wp.func
def doubled(v: wp.vec3) -> wp.vec3:
    return 2.0 * v


@wp.func
def right(s: World, p: Params, obs: Row[float], rng: Row[wp.uint32]):
    total = 0.0
    for i in range(3):  # Warp unrolls this loop; otherwise it would reject the constant total
        total += s.qpos[i] * p.gains[i]
    obs[0] = total
    obs[1] = s.qpos[-1] + s.xpos[1][2] + s.xpos[-1].x + s.xmat[0][1, 2] + s.xmat[0][-1][0]
    obs[2] = p.table[1, 2] + p.table[2][0] + last(p.table[0])
    obs[3] = float(size_of(s)) + last(s.qpos) + last(s.qpos, scale=3.0) + enclosed(s) + doubled(s.xpos[1])[1]
    _first, second = both(s)
    obs[4] = second + lw.uniform(rng, 0.0, 1.0)
    wp.atomic_add(obs, 4, 1.0)
    obs[5] = 0.0
    rounds = int(0)  # noqa: RUF046
    while rounds < 5:
        rounds += 1
        obs[5] += float(rounds)
    if wp.static(ORDER[0] == 0):
        obs[77] = 0.0
    part = p.gains[1:3]
    obs[6] = part[0] + THIS.last(part) + wp.where(s.time > 0.0, s.qpos[0], s.qpos[1])


@wp.func
def count(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.count[0] = s0.count[0] + 1.0
    s1.kept[0][ORDER[0]] = 5.0


class Right(lw.Task):
    model, obs, horizon = "hopper.xml", {"all": 7}, 5
    observe, advance = right, count


# functions with wrong indices


@wp.func
def of_nothing(s: World) -> float:
    return s.ten_length[1]


@wp.func
def observe_wrong(s: World, p: Params, obs: Row[float]):
    i = p.where + 3
    total = s.qpos[60] + s.qpos[p.where - 1] + s.qpos[-7] + s.xpos[0][i] + s.xmat[0][0, p.where + 3]
    total += doubled(p.gains)[p.where + 4] + p.table[p.where + 3, 0] + p.table[0, p.where + 5] + of_nothing(s)
    obs[0] = wp.where(total > 0.0, 1.0, 0.0)
    if s.count[0] > 1.0:
        obs[1] = 1.0


@wp.func
def control_wrong(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = action[3]


@wp.func
def advance_wrong(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.count[0] = s0.count[0] + 1.0
    if s0.count[0] == 2.0:
        s1.count[0] += s0.count[int(s0.count[0])]
        s1.kept[p.where + 2][1] = 1.0
        s1.count[p.where + 5] += 1.0
        wp.atomic_add(s1.count, p.where + 9, 1.0)


@wp.func
def reward_wrong(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.where(s1.count[1] > 0.0, 1.0, 0.0)


@wp.func
def terminated_wrong(s: World, p: Params) -> bool:
    return s.qpos[p.where + 7] > 1.0e30


@wp.func
def initialize_wrong(s: World, p: Params):
    if s.count[2] > 1.0e30:
        s.count[0] = 1.0


class Wrong(lw.Task):
    model, obs, horizon = "hopper.xml", {"x": 1}, 5
    observe, control, advance, reward = observe_wrong, control_wrong, advance_wrong, reward_wrong
    terminated, initialize = terminated_wrong, initialize_wrong


AT = r"out of range \(test_index_rules\.py, line \d+\): the index is"
MISTAKES = [
    rf"observe_wrong reads s\.qpos\[60\] {AT} 60, and there are 6 elements, 0 to 5",
    rf"reads s\.qpos\[p\.where - 1\] {AT} -1,",
    rf"reads s\.qpos\[-7\] {AT} -7,",
    rf"reads s\.xpos\[0\]\[i\] {AT} 3, and there are 3 elements",
    rf"reads s\.xmat\[0\]\[0, p\.where \+ 3\] {AT} 3, and there are 3 elements",
    rf"reads doubled\(p\.gains\)\[p\.where \+ 4\] {AT} 4, and there are 3 elements",
    rf"reads p\.table\[p\.where \+ 3, 0\] {AT} 3, and there are 3 elements",
    rf"reads p\.table\[0, p\.where \+ 5\] {AT} 5, and there are 4 elements",
    rf"of_nothing reads s\.ten_length\[1\] {AT} 1, and there are no elements",
    rf"observe_wrong writes obs\[1\] {AT} 1, and there are 1 elements",
    rf"control_wrong reads action\[3\] {AT} 3,",
    rf"advance_wrong reads s0\.count\[int\(s0\.count\[0\]\)\] {AT} 2,",
    rf"writes s1\.kept\[p\.where \+ 2\] {AT} 2, and there are 2 elements",
    rf"writes s1\.count\[p\.where \+ 5\] {AT} 5,",
    rf"writes wp\.atomic_add\(s1\.count, p\.where \+ 9, 1\.0\) {AT} 9,",
    rf"reward_wrong reads s1\.count\[1\] {AT} 1,",
    rf"terminated_wrong reads s\.qpos\[p\.where \+ 7\] {AT} 7,",
    rf"initialize_wrong reads s\.count\[2\] {AT} 2,",
]


def test_correct_functions_pass_the_index_rule() -> None:
    check_task(Right, engine="mujoco", steps=10, checks=[check_bounds])


def test_index_rule_reports_all_indices_out_of_range() -> None:
    with pytest.raises(AssertionError, match="wrong on the mujoco engine breaks the rule 'bounds': ") as caught:
        check_task(Wrong, engine="mujoco", steps=10, checks=[check_bounds])
    message = str(caught.value)
    assert message.count("\n") == 1 and message.count("; ") == len(MISTAKES) - 1
    for pattern in MISTAKES:
        assert re.search(pattern, message), f"{pattern} is not in {message}"


native = wp.func_native("row.data[0] = 1.0f;")


@native
def poke(row: Row[float]): ...


@wp.func
def calls_native(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    poke(s1.count)


@wp.func
def function_as_a_value(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    helper = last
    s1.count[0] = helper(s1.count)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (calls_native, r"calls_native passes a row .* to the native function poke \(.*, line \d+\), .*: pass numbers"),
        (function_as_a_value, r"function_as_a_value uses last as a value \(.*, line \d+\): call it instead"),
    ],
)
def test_function_that_cannot_be_checked_is_reported_by_name(function: Any, message: str) -> None:
    task = type("Unchecked", (Right,), {"advance": function})
    with pytest.raises(AssertionError, match=f"the functions could not be checked: {message}"):
        check_task(task, engine="mujoco", steps=2, checks=[check_bounds])


@wp.func
def height(s: World) -> float:
    return s.qpos[1]


@wp.func
def root(s: World) -> float:
    return wp.sqrt(s.qpos[0])  # the robot also moves backwards


@wp.struct
class Timed(Params):
    dt: float


@wp.func
def place(s: World, p: Timed, obs: Row[float]):
    obs[0] = s.qpos[0]


class Rooted(lw.Task):
    Params, observe = Timed, place
    model, obs, rewards = "hopper.xml", {"x": 1}, {"height": 1.0, "root": 1.0}


def test_term_that_is_not_a_number_is_named() -> None:
    with pytest.raises(AssertionError, match="breaks the rule 'bounds': root is NaN or infinite"):
        check_task(Rooted, engine="mujoco", nworld=2, steps=20, checks=[check_bounds])
