"""Add rough ground to velocity tasks: patches of increasing difficulty, a height scan, and changes of level.

Patches and their columns come from Isaac Lab's rough terrain, and the height scan comes from legged_gym.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.velocity import walking

TERRAIN = lw.Terrain(
    {"stairs_up": 4, "stairs_down": 4, "steps": 4, "rough": 4, "slope_up": 2, "slope_down": 2},
    scale={"steps": 0.1, "rough": 0.06},
)


@wp.struct
class World(walking.World):
    level: Row[float] = lw.lasting_memory()
    column: Row[float] = lw.lasting_memory()
    walked: Row[float] = lw.lasting_memory()  # distance from the patch's centre, m
    commanded: Row[float] = lw.lasting_memory()  # commanded distance of an episode, m
    climbed: Row[float] = lw.memory()  # 1 if the level has risen in this episode


@wp.struct
class Params(walking.Params):
    terrain: wp.array2d[float] = lw.height_field("terrain")  # heights of the ground, m
    origins: wp.array2d[wp.vec3] = TERRAIN.origins  # middle of each patch, by level and column, m
    patch: float = TERRAIN.patch  # side of a patch, m
    climbing: bool = False  # whether a robot that leaves its patch goes on in the middle of a patch of the next level
    episode_seconds: float = 20.0  # duration of a whole episode, for the commanded distance, s
    scan: wp.array[wp.vec2] = lw.scan_grid(1.6, 1.0)  # points of the height scan around the robot, m
    scan_noise: float = 0.1  # largest, m


@wp.struct
class Policy(walking.Policy):
    height_scan: Row[float] = lw.part("scan")


@wp.struct
class Critic(walking.Critic):
    height_scan: Row[float] = lw.part("scan")


@wp.func
def ground(x: wp.vec3, s: World, p: Params) -> float:
    return lw.ground_height(p.terrain, x[0], x[1])


@wp.func
def distance(x: wp.vec3, s: World, p: Params) -> float:
    return lw.ground_distance(p.terrain, x)


ground.replaces, distance.replaces = walking.ground, walking.distance


@wp.func
def base(s: World) -> wp.vec3:
    return wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2])


@wp.func
def base_height(s: World, p: Params) -> float:
    return s.qpos[2] - ground(base(s), s, p)


@wp.func
def left_field(s: World, p: Params) -> bool:
    return not lw.on_ground(p.terrain, s.qpos[0], s.qpos[1])


@wp.func
def terrain_level(level: Row[float]) -> float:
    return level[0]


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    walking.observe(s, p, obs, rng)
    lw.height_scan(obs.height_scan, p.terrain, p.scan, base(s), terms.orientation(s.qpos))
    terms.add_uniform_noise(obs.height_scan, p.scan_noise, rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    walking.observe_critic(s, p, obs)
    lw.height_scan(obs.height_scan, p.terrain, p.scan, base(s), terms.orientation(s.qpos))


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    walking.advance(s0, action, s1, p, rng)
    c = walking.command(s1, p)
    distance = wp.where(s1.climbed[0] > 0.0, 0.0, p.episode_seconds * wp.length(wp.vec2(c[0], c[1])))
    lw.follow_walk(s1.level, s1.column, s1.walked, s1.commanded, p.origins, base(s1), distance)


@wp.func
def move(s: World, p: Params, way: wp.vec3):
    """Move a robot horizontally and as high as no foot gets deeper into the ground than before."""
    rise = float(-1e6)
    for foot in range(p.feet.shape[0]):
        x, _ = walking.foot_motion(s, p, foot)
        rise = wp.max(rise, ground(x + way, s, p) - ground(x, s, p))
    lw.put(s.qpos, 0, base(s) + wp.vec3(way[0], way[1], rise))


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    walking.event(s, p, rng)
    if p.climbing and s.walked[0] > 0.5 * p.patch:
        level = lw.next_level(int(s.level[0]), s.walked[0], 0.0, p.patch, p.origins.shape[0], rng)
        s.level[0] = float(level)
        s.climbed[0] = 1.0
        move(s, p, p.origins[level, int(s.column[0])] + lw.uniform(rng, p.start_low, p.start_high) - base(s))
        lw.follow_walk(s.level, s.column, s.walked, s.commanded, p.origins, base(s), 0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    walking.randomize(s, p, rng)
    start = lw.start_on_terrain(s.level, s.column, s.walked, s.commanded, p.origins, p.patch, rng)
    for i in range(3):
        s.qpos[i] += start[i]


class Rough(walking.Velocity):
    """A robot that follows velocity commands on rough ground."""

    metrics = (*walking.Velocity.metrics, "terrain_level")
    truncations = ("left_field",)
