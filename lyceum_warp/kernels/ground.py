"""Provide Warp functions for rough ground: look up its height in a table, and choose levels of difficulty.

``lw.height_field(name)`` makes a table of the heights at the points of a regular grid. The first row holds the points'
x coordinates, and the first column their y coordinates. Heights between the points are interpolated on MuJoCo's
triangles. Each cell's diagonal runs from the corner with the smallest x and y to the corner with the largest.
"""

import warp as wp

from lyceum_warp.kernels.random import uniform
from lyceum_warp.kernels.rotations import quat_rotate


@wp.func
def triangle(low: float, right: float, left: float, high: float, u: float, v: float) -> wp.vec3:
    """Return the height at a point of a cell, and the slopes of the point's triangle along x and y.

    Args:
        low: Height at the corner with the smallest x and y.
        right: Height at the corner with the largest x.
        left: Height at the corner with the largest y.
        high: Height at the corner with the largest x and y.
        u: The point's x in the cell, between 0 and 1. The slopes are per cell, too.
        v: The point's y in the cell.
    """
    along_x, along_y = right - low, high - right
    if v > u:
        along_x, along_y = high - left, left - low
    return wp.vec3(low + u * along_x + v * along_y, along_x, along_y)


@wp.func
def _triangle(ground: wp.array2d[float], x: float, y: float) -> wp.vec3:
    """Find the triangle below a point, and return its height at the point and its slopes along x and y."""
    ny, nx = ground.shape[0] - 1, ground.shape[1] - 1
    x0, y0, x1, y1 = ground[0, 1], ground[1, 0], ground[0, nx], ground[ny, 0]
    px, py = wp.clamp(x, x0, x1), wp.clamp(y, y0, y1)
    # clamp again, for the last point and for NaN
    c = 1 + wp.clamp(int((px - x0) / (x1 - x0) * float(nx - 1)), 0, nx - 2)
    r = 1 + wp.clamp(int((py - y0) / (y1 - y0) * float(ny - 1)), 0, ny - 2)
    dx, dy = ground[0, c + 1] - ground[0, c], ground[r + 1, 0] - ground[r, 0]
    u, v = (px - ground[0, c]) / dx, (py - ground[r, 0]) / dy
    t = triangle(ground[r, c], ground[r, c + 1], ground[r + 1, c], ground[r + 1, c + 1], u, v)
    return wp.vec3(t[0], t[1] / dx, t[2] / dy)


@wp.func
def ground_height(ground: wp.array2d[float], x: float, y: float) -> float:
    """Return the height (m) of the ground at a point, on the triangles with which MuJoCo collides.

    Outside the field, the height is that of the nearest edge point, although MuJoCo has no ground there.

    Args:
        ground: The table of ``lw.height_field``.
        x: World coordinate, m.
        y: World coordinate, m.
    """
    return _triangle(ground, x, y)[0]


@wp.func
def ground_normal(ground: wp.array2d[float], x: float, y: float) -> wp.vec3:
    """Return the unit normal, upwards, of the ground's triangle at a point; see ``ground_height``."""
    t = _triangle(ground, x, y)
    return wp.normalize(wp.vec3(-t[1], -t[2], 1.0))


@wp.func
def ground_distance(ground: wp.array2d[float], point: wp.vec3) -> float:
    """Return the distance of a point from the plane of the triangle below it, m; negative below the ground.

    A sphere touches the triangle if the distance of the sphere's centre is at most the radius. Another triangle may be
    nearer to the point.
    """
    t = _triangle(ground, point[0], point[1])
    return (point[2] - t[0]) / wp.length(wp.vec3(t[1], t[2], 1.0))


@wp.func
def on_ground(ground: wp.array2d[float], x: float, y: float) -> bool:
    """Return whether the height field covers a point.

    There is no ground outside the field, so a robot that leaves it falls.
    """
    ny, nx = ground.shape[0] - 1, ground.shape[1] - 1
    return x >= ground[0, 1] and x <= ground[0, nx] and y >= ground[1, 0] and y <= ground[ny, 0]


@wp.func
def height_scan(
    row: wp.array[float],
    ground: wp.array2d[float],
    points: wp.array[wp.vec2],
    base: wp.vec3,
    orientation: wp.vec4,
):
    """Write the height of a robot's base minus the height of the ground at each of the given points.

    Args:
        row: A row, such as a part of an observation, with an element for each point.
        ground: The table of ``lw.height_field``.
        points: Points relative to the base, m, with x forwards and y to the left. The points turn with the base's yaw,
            but not with its roll and pitch.
        base: Position of the base, m.
        orientation: Orientation of the base (w, x, y, z).
    """
    forward = quat_rotate(orientation, wp.vec3(1.0, 0.0, 0.0))
    heading = wp.normalize(wp.vec2(forward[0], forward[1]))
    for i in range(points.shape[0]):
        x = base[0] + heading[0] * points[i][0] - heading[1] * points[i][1]
        y = base[1] + heading[1] * points[i][0] + heading[0] * points[i][1]
        row[i] = base[2] - ground_height(ground, x, y)


@wp.func
def _draw(count: int, rng: wp.array[wp.uint32]) -> int:
    """Draw a random whole number from 0 to ``count`` - 1."""
    return wp.min(int(uniform(rng, 0.0, float(count))), count - 1)


@wp.func
def next_level(level: int, walked: float, commanded: float, patch: float, levels: int, rng: wp.array[wp.uint32]) -> int:
    """Raise, keep or lower the terrain level for the next episode, as in Rudin et al. (2021).

    A robot that ends its episode more than half a patch from the centre of its patch moves up one level. Any other
    robot that ends it less than half the commanded distance from the centre moves down one level. Level 0 is the
    lowest. A robot that moves up from the highest level gets a random level. Source: arXiv 2109.11978, section 3.2.

    Args:
        level: The level of the episode that ended, from 0.
        walked: Horizontal distance of the robot from the centre of the patch at the end of the episode, m.
        commanded: Commanded speed at the end of the episode times the duration of a whole episode, m. If it is 0, the
            level does not fall.
        patch: Length of a patch's side, m: ``lw.Terrain.patch``.
        levels: Number of levels: ``lw.Terrain.levels``.
        rng: The world's random numbers.
    """
    if walked > 0.5 * patch:
        if level + 1 < levels:
            return level + 1
        return _draw(levels, rng)
    if walked < 0.5 * commanded:
        return wp.max(level - 1, 0)
    return level


@wp.func
def start_on_terrain(
    level: wp.array[float],
    column: wp.array[float],
    walked: wp.array[float],
    commanded: wp.array[float],
    origins: wp.array2d[wp.vec3],
    patch: float,
    rng: wp.array[wp.uint32],
) -> wp.vec3:
    """Choose the patch of a new episode, and return its centre, m; call this in ``randomize``.

    A world's first episode is at level 0, in a random column. The column never changes, and ``next_level`` chooses
    later levels.

    Args:
        level: The world's level, from 0. Declare it in World with ``lw.lasting_memory()``.
        column: The world's column, from 0. Declare it in the same way.
        walked: The walked distance, which ``follow_walk`` writes. Declare it in the same way.
        commanded: The commanded distance, which ``follow_walk`` writes. Declare it in the same way.
        origins: ``lw.Terrain.origins``, (levels, columns).
        patch: Length of a patch's side, m: ``lw.Terrain.patch``.
        rng: The world's random numbers.
    """
    if walked[0] == 0.0 and commanded[0] == 0.0:
        column[0] = float(_draw(origins.shape[1], rng))
    number = next_level(int(level[0]), walked[0], commanded[0], patch, origins.shape[0], rng)
    level[0] = float(number)
    return origins[number, int(column[0])]


@wp.func
def follow_walk(
    level: wp.array[float],
    column: wp.array[float],
    walked: wp.array[float],
    commanded: wp.array[float],
    origins: wp.array2d[wp.vec3],
    position: wp.vec3,
    distance: float,
):
    """Write the two distances that ``start_on_terrain`` needs for the next level; call this in ``advance``.

    Args:
        level: The level; see ``start_on_terrain``.
        column: The column.
        walked: Output: the horizontal distance of the robot from the centre of the patch, m.
        commanded: Output: the commanded distance, m.
        origins: ``lw.Terrain.origins``.
        position: Position of the robot.
        distance: Commanded speed at this step times the duration of a whole episode, m. If it is 0, the level does not
            fall.
    """
    way = position - origins[int(level[0]), int(column[0])]
    walked[0] = wp.length(wp.vec2(way[0], way[1]))
    commanded[0] = distance
