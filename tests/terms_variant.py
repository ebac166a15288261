"""Define a variant of a task in another file.

It adds a parameter, a field, memory and a term, and it replaces a helper function.
"""

import terms_task as parent
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World(parent.World):
    time: float
    work: Row[float] = lw.memory()


@wp.struct
class Params(parent.Params):
    gain: float = 2.0
    target: float = 0.1  # another default


@wp.func
def pushed_twice(s: World) -> float:
    return 2.0 * parent.pushed(s)


pushed_twice.replaces = parent.pushed


@wp.func
def lasting(s: World, p: Params) -> float:
    return p.gain * s.work[0]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    parent.advance(s0, action, s1, p, rng)
    s1.work[0] = s0.work[0] + action[0] * (s1.qpos[0] - s0.qpos[0]) + 0.001 * s1.time


class Variant(parent.Terms):
    rewards = parent.Terms.rewards | {"lasting": 0.5}


class Same(Variant):
    rewards = Variant.rewards | {"lasting": 5.0}
