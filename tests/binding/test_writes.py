"""The analysis of what a Warp function writes into its arguments."""

import sys
from typing import Any

import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.binding.writes import Write, check_writes, find_writes, written_fields


@wp.struct
class World:
    time: float
    qpos: Row[float]
    qvel: Row[float]
    ctrl: Row[float]
    xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    mocap_quat: Row[wp.vec4]
    xmat: Row[wp.mat33]
    memory: Row[float]


@wp.struct
class Params:
    dt: float
    gain: float
    table: wp.array2d[float]


THIS = sys.modules[__name__]
vec7 = wp.types.vector(length=7, dtype=wp.float32)


def fields(function: Any) -> set[str]:
    assert all(write.reader is None for write in find_writes(function))
    return set(written_fields(function))


def rows(function: Any) -> set[str]:
    return {write.argument for write in find_writes(function) if write.field is None}


# helpers


@wp.func
def fill(row: Row[float], x: float):
    for i in range(row.shape[0]):
        row[i] = x


@wp.func
def fill_any(row: Any, x: float):
    row[0] = x


@wp.func
def place(s: World, p: Params):
    s.mocap_pos[0] = wp.vec3(p.gain, 0.0, 0.0)


@wp.func
def places(s: World, p: Params):
    place(s, p)
    fill(s.qpos, 1.0)


@wp.func
def row_of(s: World) -> Row[float]:
    return s.qvel


@wp.func
def two_rows(s: World):
    return s.qpos, s.qvel


@wp.func
def put(s: World, x: float):
    s.qpos[0] = x


@wp.func
def put(row: Row[float], x: float):  # noqa: F811
    row[0] = x


@wp.func
def even(s: World, n: int) -> int:
    s.qpos[0] = 1.0
    if n > 0:
        return odd(s, n - 1)
    return 0


@wp.func
def odd(s: World, n: int) -> int:
    s.qvel[0] = 1.0
    if n > 0:
        return even(s, n - 1)
    return 1


native = wp.func_native("row[0] = 1.0f;")


@native
def poke(row: Row[float]): ...


# functions under test; those with the same writes stand together


@wp.func
def reads_only(s: World, p: Params, obs: Row[float]):
    position = s.mocap_pos[0]
    position[0] = 1.0  # a copy
    turned = s.xmat[0]
    turned[0, 1] = 2.0
    row = s.qpos
    obs[0] = row[0] + position.x + turned[0, 0] + float(len(s.qvel)) + float(s.qpos.shape[0])
    obs[1] = wp.where(s.time > 0.5, s.qpos[0], p.gain) + wp.length(s.xpos[0]) + p.table[0, 1]
    own = wp.zeros(shape=3, dtype=float)
    own[0] = 1.0
    obs[2] = own[0] + vec7()[0] + wp.max(float(int(s.qpos[0])), 1.0)


@wp.func
def element(s: World, p: Params):
    s.qpos[0] = 1.0


@wp.func
def augmented(s: World, p: Params):
    s.qpos[0] += 1.0


@wp.func
def in_a_tuple(s: World, p: Params):
    _x, s.qpos[0] = 1.0, 2.0


@wp.func
def alias(s: World, p: Params):
    row = s.qpos
    row[0] = 1.0


@wp.func
def alias_of_an_alias(s: World, p: Params):
    t = s
    row = t.qpos
    again = row
    again[0] = 1.0


@wp.func
def alias_in_a_loop(s: World, p: Params):
    row = s.memory
    for i in range(int(p.gain)):
        if i > 0:
            row[0] = 1.0  # from the second round on it is qpos
        row = s.qpos
    row[0] = s.memory[0]


@wp.func
def aliases_in_a_tuple(s: World, p: Params):
    a, b = s.qpos, s.qvel
    a[0] = b[0]


@wp.func
def chosen_row(s: World, p: Params):
    row = s.qpos if p.gain > 0.0 else s.qvel
    row[0] = 1.0


@wp.func
def row_in_a_struct(s: World, p: Params):
    own = World()
    own.qpos = s.qpos
    own.qpos[0] = 1.0


@wp.func
def rows_in_a_struct(s: World, p: Params) -> float:
    own = World()
    own.qpos = s.memory
    own.qvel = s.qvel[2:4]
    own.time = 1.0
    return own.qpos[0] + own.qvel[1]


@wp.func
def atomic(s: World, p: Params):
    wp.atomic_add(s.qpos, 0, 1.0)


@wp.func
def through_a_helper(s: World, p: Params):
    fill(s.qpos, 1.0)


@wp.func
def through_a_module(s: World, p: Params):
    THIS.fill(s.qpos, 1.0)


@wp.func
def through_a_generic_helper(s: World, p: Params):
    fill_any(s.qpos, 1.0)


@wp.func
def through_a_keyword(s: World, p: Params):
    fill(x=1.0, row=s.qpos)


@wp.func
def through_an_overload_for_structs(s: World, p: Params):
    put(s, 1.0)


@wp.func
def through_an_overload_for_rows(s: World, p: Params):
    put(s.qpos, 1.0)


@wp.func
def through_a_name_for_a_function(s: World, p: Params):
    helper = fill
    helper(s.qpos, 1.0)


@wp.func
def through_static(s: World, p: Params):
    wp.static(fill)(s.qpos, 1.0)


@wp.func
def in_a_branch(s: World, p: Params):
    if wp.static(THIS.vec7 is None):
        s.qvel[0] = 1.0
    elif p.gain > 1.0:
        while s.qpos[0] < 0.0:
            s.qpos[0] = 1.0


WRITE_QPOS = [
    element, augmented, in_a_tuple, alias, alias_of_an_alias, aliases_in_a_tuple, chosen_row, row_in_a_struct, atomic,
    through_a_helper, through_a_module, through_a_generic_helper, through_a_keyword, through_an_overload_for_structs,
    through_an_overload_for_rows, through_a_name_for_a_function, through_static, in_a_branch, alias_in_a_loop,
]  # fmt: skip


@pytest.mark.parametrize("function", WRITE_QPOS, ids=lambda function: function.key)
def test_a_write_of_any_form_is_found(function: Any) -> None:
    more = {chosen_row: {"qvel"}, alias_in_a_loop: {"memory"}}
    assert fields(function) == {"qpos"} | more.get(function, set())
    assert rows(function) == set()


def test_reading_and_changing_a_copy_writes_nothing() -> None:
    assert fields(reads_only) == fields(rows_in_a_struct) == set()
    assert rows(reads_only) == {"obs"}


@wp.func
def components(s: World, p: Params):
    s.mocap_pos[0].x = 1.0
    s.mocap_quat[int(p.gain)][1] = 1.0
    s.xmat[0][1, 2] = 1.0


def test_a_component_belongs_to_its_field() -> None:
    assert fields(components) == {"mocap_pos", "mocap_quat", "xmat"}


@wp.func
def nested_helpers(s: World, p: Params):
    places(s, p)


@wp.func
def returned_rows(s: World, p: Params):
    row = row_of(s)
    row[0] = 1.0
    _a, b = two_rows(s)
    b[0] = 1.0


@wp.func
def returned_row_at_once(s: World, p: Params):
    row_of(s)[0] = 1.0


def test_writes_are_followed_through_calls_and_results() -> None:
    assert fields(nested_helpers) == {"mocap_pos", "qpos"}
    assert fields(returned_row_at_once) == {"qvel"}
    assert "qvel" in fields(returned_rows)


def test_functions_that_call_each_other_are_followed_once() -> None:
    assert fields(even) == {"qpos", "qvel"}


@wp.func
def random(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -1.0, 1.0)
    s.memory[0] = lw.normal(rng)


def test_draws_write_the_random_stream() -> None:
    assert fields(random) == {"qpos", "memory"}
    assert rows(random) == {"rng"}


def made_with(row_name: str, helper: Any) -> Any:
    @wp.func
    def enclosing(s: World, p: Params):
        helper(s.ctrl, 1.0)
        if wp.static(row_name == "qvel"):
            s.qvel[0] = 1.0
        else:
            s.qpos[0] = 1.0

    return enclosing


def test_enclosed_names_are_followed() -> None:
    assert fields(made_with("qvel", fill)) == {"ctrl", "qvel"}
    assert fields(made_with("other", fill_any)) == {"ctrl", "qpos"}


@wp.func
def table_row(s: World, p: Params):
    row = p.table[1]
    row[0] = 1.0


@wp.func
def whole_fields(s: World, p: Params):
    s.time = 0.0
    s.qpos = s.qvel
    p.gain = 1.0


def test_a_row_of_a_table_and_whole_fields_are_writes() -> None:
    (write,) = find_writes(table_row)
    assert (write.target, write.replaced) == ("p.table", False)
    found = {(write.target, write.replaced) for write in find_writes(whole_fields)}
    assert found == {("s.time", True), ("s.qpos", True), ("p.gain", True)}


@wp.func
def to_native(s: World, p: Params):
    poke(s.qpos)


@wp.func
def to_a_pointer(s: World, p: Params):
    own = wp.array(ptr=s.qvel.ptr, shape=(1,), dtype=float)
    own[0] = 1.0


def test_a_function_without_source_is_named_and_counts_as_a_write() -> None:
    (write,) = find_writes(to_native)
    assert (write.field, write.reader) == ("qpos", "poke")
    assert {write.reader for write in find_writes(to_a_pointer)} == {"a pointer"}
    assert {write.field for write in find_writes(to_a_pointer)} == {"qvel"}
    assert {write.reader for write in find_writes(poke)} == {"poke"}
    assert written_fields(to_native) == {"qpos"}


def test_a_write_has_its_place_in_the_file() -> None:
    (write,) = find_writes(alias)
    with open(__file__) as file:
        line = file.read().splitlines()[write.line - 1]
    assert line == "    row[0] = 1.0" and write.file == "test_writes.py"
    assert write == Write(0, "s", "qpos", "alias", "test_writes.py", write.line)
    (inner,) = find_writes(through_a_helper)
    assert inner.function == "fill"


RIGHTS = {
    "observe": {"s": (), "p": (), "obs": None},
    "control": {"s": ("mocap_pos", "mocap_quat"), "action": (), "p": (), "ctrl": None},
    "reward": {"s0": (), "action": (), "s1": (), "p": ()},
    "advance": {"s0": (), "action": (), "s1": ("memory",), "p": (), "rng": None},
    "initialize": {"s": ("qpos", "qvel", "mocap_pos", "memory"), "p": ()},
}


@wp.func
def good_control(world: World, given: Row[float], q: Params, out: Row[float]):
    place(world, q)
    out[0] = given[0]


@wp.func
def bad_action(world: World, given: Row[float], q: Params, out: Row[float]):
    given[0] = 1.0


@wp.func
def bad_reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    fill(s1.memory, 1.0)
    return 1.0


@wp.func
def bad_advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.memory[0] = 0.0
    s0.memory[0] = 1.0


@wp.func
def writes_derived(s: World, p: Params):
    s.xpos[0] = wp.vec3()


@wp.func
def writes_time(s: World, p: Params):
    s.time = 0.0


@wp.func
def replaces_a_row(s: World, p: Params):
    s.qpos = s.qvel


@wp.func
def writes_params(s: World, p: Params):
    p.gain = 2.0


REFUSED = {
    "an action": (
        "control", bad_action,
        r"control of the task 'mine' writes given \(test_writes\.py, line \d+\): control may write ctrl, mocap_pos, "
        "mocap_quat",
    ),
    "memory in reward": (
        "reward", bad_reward,
        r"reward of the task 'mine' writes s1\.memory in fill \(test_writes\.py, line \d+\): reward may write nothing, "
        "and memory is written by advance or initialize",
    ),
    "memory of the state before": (
        "advance", bad_advance,
        r"advance of the task 'mine' writes s0\.memory \(.*\): advance may write memory of s1 only",
    ),
    "a derived field": (
        "initialize", writes_derived,
        r"initialize of the task 'mine' writes s\.xpos \(.*\): initialize may write qpos, qvel, mocap_pos, memory, and "
        "no function may write xpos",
    ),
    "time": ("initialize", writes_time, r"initialize of the task 'mine' writes s\.time \(.*no function may write time"),
    "a whole row": ("initialize", replaces_a_row, r"writes s\.qpos \(.*\): write its elements, as s\.qpos\[0\] = "),
    "a parameter": ("initialize", writes_params, r"writes p\.gain \(.*\): parameters are changed with env\.set_params"),
    "a native function": (
        "observe", to_native,
        r"observe of the task 'mine' gives s\.qpos to poke \(test_writes\.py, line \d+\), which may write it and has "
        "no source that can be read: give it numbers instead",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "function", "message"), REFUSED.values(), ids=REFUSED)
def test_a_write_that_the_form_does_not_allow_is_one_line(name: str, function: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        check_writes("mine", {name: function}, RIGHTS)
    assert "\n" not in str(caught.value)


def test_writes_that_the_form_allows_pass() -> None:
    check_writes("mine", {"control": good_control, "initialize": alias}, RIGHTS)
    check_writes("mine", {"observe": reads_only}, RIGHTS)
