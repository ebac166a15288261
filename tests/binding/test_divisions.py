import ast

import warp as wp

from lyceum_warp import Row
from lyceum_warp.binding.divisions import integer_divisions
from lyceum_warp.binding.sources import source_of

COUNT = wp.constant(3)


@wp.struct
class Params:
    n: int
    x: float
    table: wp.array[int]
    grid: wp.array2d[int]


@wp.func
def whole(x: float) -> int:
    return int(x)


@wp.func
def pair(x: float) -> tuple[int, float]:
    return 1, x


@wp.func
def untyped(n: int):
    return n + 1


@wp.func
def integers(p: Params, row: Row[float], x: float, n: int):
    row[0] = float(1 / 2)
    row[0] = float(n / 2)
    row[0] = float(p.n / COUNT)
    row[0] = float(p.table[0] / p.table[1])
    row[0] = float(p.grid[0, 1] / 2)
    cells = p.grid[0]
    row[0] = float(cells[0] / 2)
    row[0] = float((row.shape[0] + 1) / 2)
    row[0] = float(len(row) / 2)
    for i in range(n):
        row[i] = float(i / n)
    k, y = pair(x)
    row[0] = float(k / 2)
    row[0] = float(whole(x) / 2)
    row[0] = float(untyped(n) / 2)
    row[0] = float(wp.max(1, n) / 2)
    row[0] = float(-1 / 2)
    row[0] = float(wp.int32(x) / 2)
    count = wp.int32(0)
    while x > y:
        count += 1
    row[0] = float(count / n)
    row[0] = float((1 if x > 0.0 else 2) / 2)
    row[0] = float(wp.randi(wp.rand_init(n), 0, 9) / 2)
    count /= 2


@wp.func
def others(p: Params, row: Row[float], x: float, n: int):
    k, y = pair(x)
    row[0] = 1.0 / 2.0
    row[0] = float(n) / 2.0
    row[0] = y / x
    row[0] = row[0] / p.x
    row[0] = wp.static(1 / 2)
    row[0] = wp.max(x, 0.0) / wp.length(wp.vec3(x))
    row[0] = wp.where(x > 0.0, x, 1.0) / wp.float32(p.n)
    row[0] = (wp.vec3(x) / 2.0)[0] / wp.pi
    row[0] = float(n // 2 + k // n)
    row[0] /= 2.0


def test_all_divisions_of_integers_are_found_and_no_others() -> None:
    lines = [line.strip() for line in ast.unparse(source_of(integers).tree).splitlines() if "/" in line]
    found = [ast.unparse(division) for division in integer_divisions(integers)]
    assert len(found) == len(lines) == 19 and all(map(str.__contains__, lines[:-1], found))
    assert found[-1] == "count / 2" and integer_divisions(others) == []
