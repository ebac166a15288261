import sys
from typing import Any

import warp as wp

from lyceum_warp import Row
from lyceum_warp.binding import written_fields
from lyceum_warp.binding.writes import trace


@wp.struct
class World:
    time: float
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    memory: Row[float]


@wp.struct
class Params:
    gain: float
    table: wp.array2d[float]


THIS = sys.modules[__name__]
vec7 = wp.types.vector(length=7, dtype=wp.float32)


@wp.func
def fill(row: Row[float], x: float):
    for i in range(row.shape[0]):
        row[i] = x


@wp.func
def fill_any(row: Any, x: float):
    row[0] = x


# each field of this struct is named after the expression that writes it


@wp.struct
class Forms:
    element: Row[float]
    augmented: Row[float]
    in_a_tuple: Row[float]
    alias: Row[float]
    component: Row[wp.vec3]
    component_by_index: Row[wp.vec3]
    of_a_matrix: Row[wp.mat33]
    by_a_module: Row[float]
    by_a_generic: Row[float]
    by_a_keyword: Row[float]
    by_an_overload: Row[float]
    of_a_struct: Row[float]
    by_static: Row[float]
    in_a_loop: Row[float]
    of_a_local_struct: Row[float]
    not_at_all: Row[float]


@wp.func
def put(s: Forms, x: float):
    s.of_a_struct[0] = x


@wp.func
def put(row: Row[float], x: float):  # noqa: F811
    row[0] = x


@wp.func
def writes_forms(s: Forms, p: Params):
    s.element[0] = s.not_at_all[0]
    s.augmented[0] += 1.0
    _x, s.in_a_tuple[0] = 1.0, 2.0
    t = s
    row = t.alias
    again = row[1:3]
    again[0] = 1.0
    s.component[0].x = 1.0
    s.component_by_index[int(p.gain)][1] = 1.0
    s.of_a_matrix[0][1, 2] = 1.0
    THIS.fill(s.by_a_module, 1.0)
    fill_any(s.by_a_generic, 1.0)
    fill(x=1.0, row=s.by_a_keyword)
    put(s.by_an_overload, 1.0)
    put(s, 1.0)
    wp.static(fill)(s.by_static, 1.0)
    if wp.static(THIS.vec7 is None):
        s.not_at_all[0] = 1.0
    elif p.gain > 1.0:
        own = Forms()
        while s.in_a_loop[0] < 0.0:
            s.in_a_loop[0] = 1.0
            if s.in_a_loop[1] > 0.0:
                own.element[0] = 1.0
            own.element = s.of_a_local_struct


def test_all_kinds_of_writes_are_found() -> None:
    assert written_fields(writes_forms) == {*Forms.vars} - {"not_at_all"}
    assert {write.use for write in trace(writes_forms).writes} == {None}


@wp.struct
class Uses:
    atomic: Row[float]
    returned: Row[float]
    unpacked: Row[float]
    chosen: Row[float]
    by_where: Row[float]
    before: Row[float]
    after: Row[float]
    in_a_struct: Row[float]
    by_an_attribute: Row[float]
    by_another: Row[float]
    by_a_name: Row[float]
    by_reference: Row[float]
    by_pointer: Row[float]
    by_native: Row[float]


@wp.func
def row_of(s: Uses) -> Row[float]:
    return s.returned


@wp.func
def reads_row_of(s: Uses) -> float:
    return s.before[0]


@wp.func
def advanced(x: wp.ref[float]):
    x += 1.0


native = wp.func_native("row[0] = 1.0f;")


@native
def poke(row: Row[float]): ...


@wp.func
def uses_rows(s: Uses, p: Params):
    wp.atomic_add(s.atomic, 0, 1.0)
    row_of(s)[0] = 1.0
    a, _b = s.unpacked, 1.0
    a[0] = 1.0
    c = s.chosen if p.gain > 0.0 else s.chosen  # noqa: RUF034
    c[0] = 1.0
    wp.where(p.gain > 0.0, s.by_where, s.by_where)[0] = 1.0
    row = s.before
    for i in range(int(p.gain)):
        if i > 0:
            row[0] = 1.0  # from the second iteration on, the name refers to a different array
        row = s.after
    first, second = Uses(), Uses()
    first.before = s.in_a_struct
    reads_row_of(first)
    second.after = s.by_an_attribute
    second.after = s.by_another
    helper = fill
    helper(s.by_a_name, 1.0)
    advanced(s.by_reference[0])
    pointed = wp.array(ptr=s.by_pointer.ptr, shape=(1,), dtype=float)
    pointed[0] = 1.0
    poke(s.by_native)


def test_untraceable_use_of_an_array_is_reported_as_a_write() -> None:
    assert {write.field for write in trace(uses_rows).writes if write.use is not None} == {*Uses.vars}


@wp.func
def reads_only(s: World, p: Params, obs: Row[float]):
    position = s.mocap_pos[0]
    position[0] = 1.0
    turned = s.xmat[0]
    turned[0, 1] = 2.0
    row = s.qpos
    obs[0] = row[0] + position.x + turned[0, 0] + float(len(s.qvel)) + float(s.qpos.shape[0])
    obs[1] = wp.where(s.time > 0.5, s.qpos[0], p.gain) + wp.length(s.xpos[0]) + p.table[0, 1]
    local = World()
    local.qpos = s.memory
    local.qvel = s.qvel[2:4]
    local.time = local.qpos[0] + local.qvel[1]
    own = wp.zeros(shape=3, dtype=float)
    fill(own, local.time)
    own[0] = 1.0
    obs[2] = own[0] + vec7()[0] + wp.max(float(int(s.qpos[0])), 1.0)


def test_changing_a_copy_of_an_argument_is_not_a_write() -> None:
    assert {write.target for write in trace(reads_only).writes} == {"obs"}


@wp.func
def searches(s: World, p: Params) -> int:
    return wp.lower_bound(s.qpos, 0.5) + len(s.qvel)


def test_search_in_a_row_reads_it() -> None:
    assert trace(searches).reads.keys() == {"qpos"}


def made_with(row_name: str, helper: Any) -> Any:
    @wp.func
    def enclosing(s: World, p: Params):
        helper(s.memory, 1.0)
        if wp.static(row_name == "qvel"):
            s.qvel[0] = 1.0
        else:
            s.qpos[0] = 1.0

    return enclosing


def test_functions_in_closures_are_analysed() -> None:
    assert written_fields(made_with("qvel", fill)) == {"memory", "qvel"}
    assert written_fields(made_with("other", fill_any)) == {"memory", "qpos"}
