"""Draw from counter-based random streams: a draw depends only on (seed, world, episode, step).

Each stream starts at a hash of the four numbers. If it started at their sum, seed 0 with episode 1 would have the same
stream as seed 1 with episode 0.
"""

import warp as wp


@wp.func
def world_key(seed: int, world: int) -> wp.uint32:
    """Return the key from which all random streams of a world are derived."""
    return wp.rand_init(seed, world)


@wp.func
def stream(key: wp.uint32, episode: int, step: int) -> wp.uint32:
    """Return the start of the random stream for one step of an episode; step 0 is the reset."""
    return wp.rand_init(int(wp.rand_init(int(key), episode)), step)


@wp.func
def substream(base: wp.uint32, number: int) -> wp.uint32:
    """Return the start of one of several independent streams that are derived from ``base``."""
    return wp.rand_init(int(base), number)


@wp.func
def uniform(rng: wp.array[wp.uint32], low: wp.vec2, high: wp.vec2) -> wp.vec2:
    value = wp.vec2()
    for i in range(2):
        value[i] = uniform(rng, low[i], high[i])
    return value


@wp.func
def uniform(rng: wp.array[wp.uint32], low: wp.vec3, high: wp.vec3) -> wp.vec3:
    value = wp.vec3()
    for i in range(3):
        value[i] = uniform(rng, low[i], high[i])
    return value


@wp.func
def uniform(rng: wp.array[wp.uint32], low: float, high: float) -> float:
    """Draw from U(low, high) and advance the stream. Each element of a vector is drawn from its own range.

    Warp passes numbers by value, so a function cannot change a number of its caller. The stream is therefore a row with
    one element.
    """
    state = rng[0]
    value = wp.randf(state, low, high)
    rng[0] = state
    return value


@wp.func
def normal(rng: wp.array[wp.uint32]) -> float:
    """Draw from N(0, 1) and advance the stream."""
    state = rng[0]
    value = wp.randn(state)
    rng[0] = state
    return value


@wp.kernel(enable_backward=False)
def seed_worlds(
    mask_in: wp.array[bool],
    seed_in: wp.array[int],
    first: int,
    key_out: wp.array[wp.uint32],
    episode_out: wp.array[int],
):
    """Seed the streams of the masked worlds, before their first episode; launched over (nworld,).

    ``first`` is the number of the first world: the worlds have the numbers first, first + 1, and so on.
    """
    w = wp.tid()
    if mask_in[w]:
        key_out[w] = world_key(seed_in[0], first + int(w))
        episode_out[w] = -1
