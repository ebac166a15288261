import re
import sys
from typing import Any

import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing.checked_functions import Unchecked, checked_functions

THIS = sys.modules[__name__]


@wp.struct
class World:
    time: float
    qpos: Row[float]
    site_xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    sensordata: Row[float]


@wp.struct
class Params:
    dt: float
    where: int
    table: wp.array2d[float]
    gains: wp.vec3


@wp.struct
class Batch:
    time: wp.array[float]
    qpos: wp.array2d[float]
    site_xpos: wp.array2d[wp.vec3]
    xmat: wp.array2d[wp.mat33]
    sensordata: wp.array2d[float]


@wp.func
def view(batch: Batch, w: int) -> World:
    s = World()
    s.time = batch.time[w]
    s.qpos = batch.qpos[w]
    s.site_xpos = batch.site_xpos[w]
    s.xmat = batch.xmat[w]
    s.sensordata = batch.sensordata[w]
    return s


VIEWS = {World: view}


# correct functions with every construct that Warp supports

ORDER = wp.constant(wp.vec3i(2, 1, 0))


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
    for i in range(3):  # Warp unrolls this loop, because the loop changes a constant
        total += s.qpos[i] * p.gains[i]
    obs[0] = total
    obs[1] = s.qpos[-1] + s.site_xpos[1][2] + s.site_xpos[-1].x + s.xmat[0][1, 2] + s.xmat[0][-1][0]
    s.site_xpos[0][ORDER[0]] = 5.0
    obs[2] = s.site_xpos[0][2] + p.table[1, 2] + p.table[2][0] + last(p.table[0])
    obs[3] = float(size_of(s)) + last(s.qpos) + last(s.qpos, scale=3.0) + enclosed(s) + doubled(s.site_xpos[1])[1]
    _first, second = both(s)
    obs[4] = second + lw.uniform(rng, 0.0, 1.0)
    wp.atomic_add(obs, 4, 1.0)
    rounds = int(0)  # noqa: RUF046
    while rounds < 5:
        rounds += 1
        obs[5] += float(rounds)
    if wp.static(ORDER[0] == 0):
        obs[77] = 0.0
    part = p.gains[1:3]
    obs[6] = part[0] + THIS.last(part) + wp.where(s.time > 0.0, s.qpos[0], s.qpos[1])


@wp.func
def of_nothing(s: World) -> float:
    return s.sensordata[0]


@wp.func
def wrong(s: World, p: Params, out: Row[float]):
    i = 3
    total = s.qpos[4] + s.qpos[p.where - 1] + s.qpos[-5] + s.site_xpos[0][i] + s.xmat[0][0, p.where + 3]
    total += doubled(p.gains)[p.where + 4] + p.table[p.where + 3, 0] + p.table[0, p.where + 5] + of_nothing(s)
    s.site_xpos[p.where + 2][1] = 1.0
    s.qpos[p.where + 7] += 1.0
    wp.atomic_add(s.qpos, p.where + 9, 1.0)
    x = float(0.0)
    while x < 2.0e6:
        x += 1.0
    out[0] = total


AT = r"out of range \(test_checked_functions\.py, line \d+\): the index is"
FINDINGS = [
    rf"wrong reads s\.qpos\[4\] {AT} 4, and there are 4 elements, 0 to 3",
    rf"reads s\.qpos\[p\.where - 1\] {AT} -1,",
    rf"reads s\.qpos\[-5\] {AT} -5,",
    rf"reads s\.site_xpos\[0\]\[i\] {AT} 3, and there are 3 elements",
    rf"reads s\.xmat\[0\]\[0, p\.where \+ 3\] {AT} 3, and there are 3 elements",
    rf"reads doubled\(p\.gains\)\[p\.where \+ 4\] {AT} 4, and there are 3 elements",
    rf"reads p\.table\[p\.where \+ 3, 0\] {AT} 3, and there are 3 elements",
    rf"reads p\.table\[0, p\.where \+ 5\] {AT} 5, and there are 4 elements",
    rf"of_nothing reads s\.sensordata\[0\] {AT} 0, and there are no elements",
    rf"writes s\.site_xpos\[p\.where \+ 2\] {AT} 2, and there are 2 elements",
    rf"writes s\.qpos\[p\.where \+ 7\] {AT} 7,",
    rf"writes wp\.atomic_add\(s\.qpos, p\.where \+ 9, 1\.0\) {AT} 9,",
    r"wrong is still in its loop 'while x < 2000000\.0' after 1000000 rounds \(.*, line \d+\)",
]


KEPT: list[wp.array] = []
"""Other arrays point to these arrays, so they must stay alive."""


DEVICE = wp.get_device("cpu")


@pytest.fixture(scope="module")
def params() -> wp.array:
    p = Params()
    p.dt, p.where, p.gains = 0.5, 0, wp.vec3(1.0, 2.0, 3.0)
    p.table = wp.array(np.arange(12.0).reshape(3, 4), dtype=float)
    KEPT.append(p.table)
    return wp.array([p], dtype=Params)


def batch() -> Any:
    made = Batch()
    made.time = wp.array([1.0, 0.0], dtype=float)
    made.qpos = wp.array(np.arange(8.0).reshape(2, 4), dtype=float)
    made.site_xpos = wp.array(np.arange(12.0).reshape(2, 2, 3), dtype=wp.vec3)
    made.xmat = wp.array(np.arange(18.0).reshape(2, 1, 3, 3), dtype=wp.mat33)
    memory = wp.zeros((2, 1), dtype=float)
    made.sensordata = wp.array(ptr=memory.ptr, shape=(2, 0), strides=memory.strides, dtype=float)
    KEPT.append(memory)
    return made


@wp.kernel(module="unique")
def run_right(batch: Batch, params: wp.array[Params], obs: wp.array2d[float], rng: wp.array2d[wp.uint32]):
    w = wp.tid()
    right(view(batch, w), params[0], obs[w], rng[w])


def test_checked_copy_of_a_correct_function_gives_equal_results_without_findings(params: wp.array) -> None:
    checked = checked_functions("test.right", {"right": right}, VIEWS, DEVICE)
    report = checked.report(DEVICE)
    results = []
    for kernel, first in ((checked.kernels["right"], [report]), (run_right, [])):
        s, obs, rng = batch(), wp.zeros((2, 7), dtype=float), wp.array([[1], [2]], dtype=wp.uint32)
        wp.launch(kernel, 2, [*first, s, params, obs, rng], device=DEVICE)
        results.append((obs.numpy(), s.site_xpos.numpy(), rng.numpy()))
    for found, wanted in zip(*results, strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert checked.problems(report) == []
    assert checked_functions("test.right", {"right": right}, VIEWS, DEVICE) is checked


def test_checked_copy_reports_indices_out_of_range_and_endless_loops(params: wp.array) -> None:
    checked = checked_functions("test.wrong", {"wrong": wrong}, VIEWS, DEVICE)
    report = checked.report(DEVICE)
    wp.launch(checked.kernels["wrong"], 2, [report, batch(), params, wp.zeros((2, 1), dtype=float)], device=DEVICE)
    problems = checked.problems(report)
    assert len(problems) == len(FINDINGS), problems
    for pattern in FINDINGS:
        assert any(re.search(pattern, problem) and "\n" not in problem for problem in problems), (pattern, problems)


native = wp.func_native("return row.data[0];")


@native
def peek(row: Row[float]) -> float: ...


@wp.func
def calls_native(s: World, p: Params) -> float:
    return peek(s.qpos)


@wp.func
def function_as_a_value(s: World, p: Params) -> float:
    helper = last
    return helper(s.qpos)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (calls_native, r"calls_native calls the native function peek \(.*, line \d+\), which has no source in Python"),
        (function_as_a_value, r"function_as_a_value uses last as a value \(.*, line \d+\): call it instead"),
    ],
)
def test_function_that_cannot_be_checked_is_reported_by_name(function: Any, message: str) -> None:
    with pytest.raises(Unchecked, match=message):
        checked_functions("test.unchecked", {"function": function}, VIEWS, DEVICE)
