"""Plan by sampling: shift plans, add noise, weigh and average samples.

Plans have the shape (horizon, nplant, nact). Actions of samples have the shape (horizon, nsample, nact), with the
samples of a plant in consecutive rows. With spline knots, the first axis has one entry per knot.
"""

import warp as wp

from lyceum_warp.kernels.faults import is_out_of_range
from lyceum_warp.kernels.random import stream, world_key
from lyceum_warp.kernels.rollouts import first_row, plant_of

NOISE = wp.constant(-2)
"""Replaces the episode number in the random streams of the noise, so that they differ from all streams of worlds."""
DRAWS = wp.constant(-3)
"""Replaces the episode number in the stream keys of the samples."""

ALL_FAILED, BAD_WEIGHTS, BAD_FIT = 1, 2, 4
"""Bits of a plan's problems: all samples failed; invalid weights; numbers of ``PlanUpdate.fit`` that are not finite."""

_TILES = f"{__name__}.tiles"
"""The Warp module of the kernels that use tiles. On the CPU, all kernels of a module write the same shared variable,
which holds the address of the tiles. Therefore ``graphs.capture`` serialises these kernels."""


@wp.kernel(enable_backward=False)
def shift_plan(
    plan_in: wp.array3d[float], steps_in: wp.array[int], fill_in: wp.array[float], repeat: bool,
    nominal_out: wp.array3d[float],
):  # fmt: skip
    """Move plans forward in time and fill their ends; launched over (horizon or knots, nplant, nact)."""
    t, p, i = wp.tid()
    last = plan_in.shape[0] - 1
    if steps_in[p] <= last - t:
        nominal_out[t, p, i] = plan_in[t + steps_in[p], p, i]
    else:
        nominal_out[t, p, i] = wp.where(repeat, plan_in[last, p, i], fill_in[i])


@wp.kernel(enable_backward=False)
def draw_noise(seed_in: wp.array[int], count_in: wp.array[int], noise_out: wp.array3d[float]):
    """Draw standard normal numbers, determined by (seed, sample, count, action, step); launched over (nsample, nact).

    Each plant has its own seed and count. The samples of each plant are numbered from 0.
    """
    k, i = wp.tid()
    nsample, plants = noise_out.shape[1], seed_in.shape[0]
    p = plant_of(k, nsample, plants)
    key = stream(world_key(seed_in[p], k - first_row(p, nsample, plants)), NOISE, 0)
    rng = stream(key, count_in[p], i)
    for t in range(noise_out.shape[0]):
        noise_out[t, k, i] = wp.randn(rng)


@wp.kernel(enable_backward=False)
def draw_keys(seed_in: wp.array[int], count_in: wp.array[int], key_out: wp.array[wp.uint32]):
    """Make the samples' stream keys from (seed, sample, count); launched over (nworld,).

    The samples' keys differ from the plant's keys, so no sample can foresee the plant's random numbers.
    """
    w = wp.tid()
    worlds, plants = key_out.shape[0], seed_in.shape[0]
    p = plant_of(w, worlds, plants)
    key_out[w] = stream(world_key(seed_in[p], w - first_row(p, worlds, plants)), DRAWS, count_in[p])


@wp.kernel(enable_backward=False)
def perturb(
    nominal_in: wp.array3d[float],
    noise_in: wp.array3d[float],
    scale_in: wp.array2d[float],
    diagonal: bool,
    deviation_in: wp.array3d[float],
    smoothing: wp.vec3,
    include_plan: bool,
    low_in: wp.array[float],
    high_in: wp.array[float],
    action_out: wp.array3d[float],
):
    """Add correlated, smoothed noise to plans, and clip the actions to their bounds; launched over (nsample, nact).

    ``scale_in`` is the lower Cholesky factor L of the noise covariance: n_t = L z_t for standard normal z_t. Smoothing
    follows trajopt: e_t = n_t in the first two steps, then e_t = b0 n_t + b1 e_(t-1) + b2 e_(t-2). If there are
    deviations, one for each element of the plan, they multiply e_t. If ``include_plan`` is set, a plant's first sample
    is the plan without noise.
    """
    k, i = wp.tid()
    nsample, plants = noise_in.shape[1], nominal_in.shape[1]
    p = plant_of(k, nsample, plants)
    exact = include_plan and k == first_row(p, nsample, plants)
    last, before_last = float(0.0), float(0.0)
    first = wp.where(diagonal, i, 0)
    for t in range(noise_in.shape[0]):
        e = float(0.0)
        for j in range(first, i + 1):
            e += scale_in[i, j] * noise_in[t, k, j]
        if t >= 2:
            e = smoothing[0] * e + smoothing[1] * last + smoothing[2] * before_last
        before_last = last
        last = e
        if deviation_in.shape[0] > 0:
            e = deviation_in[t, p, i] * e
        if exact:
            e = 0.0
        action_out[t, k, i] = wp.clamp(nominal_in[t, p, i] + e, low_in[i], high_in[i])


@wp.kernel(enable_backward=False)
def add_up(
    reward_in: wp.array2d[float],
    terminated_in: wp.array2d[bool],
    fault_in: wp.array[int],
    terminal_in: wp.array[float],
    discount: float,
    stop: bool,
    return_out: wp.array[float],
):
    """Add up the worlds' discounted rewards and terminal values; launched over (nworld,).

    If ``stop`` is set, a sample gets no reward and no terminal value after its episode has terminated. The return is
    minus infinity if the sample has a fault, if a reward is a fault, or if the sum is not finite.
    """
    k = wp.tid()
    total = float(0.0)
    weight = float(1.0)
    going = bool(True)
    failed = bool(fault_in[k] != 0)
    for t in range(reward_in.shape[0]):
        if going:
            failed = failed or is_out_of_range(reward_in[t, k])
            total += weight * reward_in[t, k]
            weight *= discount
            if stop and terminated_in[t, k]:
                going = False
    if going:
        total += weight * terminal_in[k]
    if failed or not wp.isfinite(total):
        total = -wp.inf
    return_out[k] = total


@wp.kernel(enable_backward=False)
def combine_models(world_return_in: wp.array[float], worst: bool, return_out: wp.array[float]):
    """Compute the mean or the minimum of each sample's returns over several models; launched over (nsample,).

    The worlds of a sample are consecutive. A sample that fails in any of the models counts as failed.
    """
    k = wp.tid()
    models = world_return_in.shape[0] // return_out.shape[0]
    total, smallest = float(0.0), float(wp.inf)
    for w in range(k * models, (k + 1) * models):
        total += world_return_in[w] / float(models)
        smallest = wp.min(smallest, world_return_in[w])
    total = wp.where(worst, smallest, total)
    return_out[k] = wp.where(wp.isfinite(total), total, -wp.inf)


@wp.kernel(enable_backward=False, module=_TILES)
def weigh(
    return_in: wp.array[float],
    rank_in: wp.array[int],
    elites: int,
    temperature: float,
    weight_out: wp.array[float],
    summary_out: wp.array2d[float],
):
    """Weigh samples; launched with one block for each plant.

    With ``elites``, the best samples that did not fail have equal weights. Otherwise, w = exp((R - max R) /
    temperature), divided by the sum. If all samples failed, all weights are zero. The summary is the best return, the
    mean return, the effective sample size 1 / sum w^2, and the number of failed samples.
    """
    p, lane = wp.tid()
    n = return_in.shape[0] // summary_out.shape[0]
    first, end = p * n, (p + 1) * n
    best = float(-wp.inf)
    for k in range(first + lane, end, wp.block_dim()):
        best = wp.max(best, return_in[k])
    best = wp.tile_extract(wp.tile_max(wp.tile(best)), 0)
    total, square, mean, good = float(0.0), float(0.0), float(0.0), float(0.0)
    for k in range(first + lane, end, wp.block_dim()):
        weight = float(0.0)
        if return_in[k] > -wp.inf:
            if elites == 0:
                weight = wp.exp((return_in[k] - best) / temperature)
            elif rank_in[k] < elites:
                weight = 1.0
            total += weight
            square += weight * weight
            mean += return_in[k]
            good += 1.0
        weight_out[k] = weight
    total = wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)
    square = wp.tile_extract(wp.tile_sum(wp.tile(square)), 0)
    mean = wp.tile_extract(wp.tile_sum(wp.tile(mean)), 0)
    good = wp.tile_extract(wp.tile_sum(wp.tile(good)), 0)
    for k in range(first + lane, end, wp.block_dim()):
        if return_in[k] > -wp.inf:
            weight_out[k] = weight_out[k] / total
    if lane == 0:
        summary_out[p, 0] = best
        summary_out[p, 1] = mean / good
        summary_out[p, 2] = wp.where(elites == 0, total * total / square, total)
        summary_out[p, 3] = float(n) - good


@wp.kernel(enable_backward=False)
def rank(return_in: wp.array[float], samples: int, rank_out: wp.array[int]):
    """Rank the samples of each plant, with rank 0 for the best; between equal samples, the lower index ranks first.

    Launched over (nsample,).
    """
    k = wp.tid()
    better = int(0)
    first = k // samples * samples
    for j in range(first, first + samples):
        if return_in[j] > return_in[k] or (return_in[j] == return_in[k] and j < k):
            better += 1
    rank_out[k] = better


@wp.kernel(enable_backward=False, module=_TILES)
def check_weights(
    return_in: wp.array[float], weight_in: wp.array[float], valid_out: wp.array[bool], problem_inout: wp.array[int]
):
    """Check the weights of each plant's samples; launched with one block for each plant.

    Weights are valid if they are finite, not negative, 0 for failed samples, and sum to 1.
    """
    p, lane = wp.tid()
    n = return_in.shape[0] // valid_out.shape[0]
    total, wrong, good = float(0.0), float(0.0), float(0.0)
    for k in range(p * n + lane, (p + 1) * n, wp.block_dim()):
        weight = weight_in[k]
        total += weight
        if return_in[k] > -wp.inf:
            good += 1.0
            if not (weight >= 0.0):
                wrong += 1.0
        elif weight != 0.0:
            wrong += 1.0
    total = wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)
    wrong = wp.tile_extract(wp.tile_sum(wp.tile(wrong)), 0)
    good = wp.tile_extract(wp.tile_sum(wp.tile(good)), 0)
    if lane == 0:
        valid = good > 0.0 and wrong == 0.0 and wp.abs(total - 1.0) < 1.0e-3
        valid_out[p] = valid
        if not valid:
            problem_inout[p] = problem_inout[p] | wp.where(good > 0.0, BAD_WEIGHTS, ALL_FAILED)


@wp.kernel(enable_backward=False)
def undo_bad_fit(
    valid_in: wp.array[bool], before_in: wp.array3d[float], problem_inout: wp.array[int], after_inout: wp.array3d[float]
):
    """Undo changes that are not finite, and all changes for plants without valid weights.

    Launched over (horizon or knots, nplant, nact).
    """
    t, p, i = wp.tid()
    if not valid_in[p]:
        after_inout[t, p, i] = before_in[t, p, i]
    elif not wp.isfinite(after_inout[t, p, i]):
        after_inout[t, p, i] = before_in[t, p, i]
        problem_inout[p] = problem_inout[p] | BAD_FIT


@wp.func
def plan_element(number: int, plants: int, nact: int) -> tuple[int, int, int]:
    """Return the row, the plant and the column of an element of the plans."""
    row = number // nact
    t = row // plants
    return t, row - t * plants, number - row * nact


@wp.kernel(enable_backward=False, module=_TILES)
def fit_deviation(
    weight_in: wp.array[float],
    action_in: wp.array3d[float],
    plan_in: wp.array3d[float],
    spread_in: wp.array[float],
    smallest_in: wp.array[float],
    deviation_in: wp.array3d[float],
    summary_in: wp.array2d[float],
    deviation_out: wp.array3d[float],
):
    """Fit the standard deviation of the noise to the weighted samples.

    The launch has one block for each element of the plans. The plan is the weighted mean of the samples. The result is
    the samples' standard deviation around this mean, divided by ``spread``, but at least ``smallest``. ``spread`` is
    the standard deviation that smoothing gives to standard normal noise in each step. If all samples failed, the
    standard deviation does not change.
    """
    number, lane = wp.tid()
    nsample, plants, nact = weight_in.shape[0], plan_in.shape[1], plan_in.shape[2]
    t, p, i = plan_element(number, plants, nact)
    total = float(0.0)
    for k in range(first_row(p, nsample, plants) + lane, first_row(p + 1, nsample, plants), wp.block_dim()):
        distance = action_in[t, k, i] - plan_in[t, p, i]
        total += weight_in[k] * distance * distance
    total = wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)
    if lane == 0:
        deviation = wp.max(wp.sqrt(total) / spread_in[t], smallest_in[i])
        deviation_out[t, p, i] = wp.where(summary_in[p, 0] > -wp.inf, deviation, deviation_in[t, p, i])


@wp.kernel(enable_backward=False, module=_TILES)
def average(
    weight_in: wp.array[float],
    action_in: wp.array3d[float],
    nominal_in: wp.array3d[float],
    valid_in: wp.array[bool],
    plan_out: wp.array3d[float],
):
    """Average the samples' actions by their weights; launched with one block for each element of the plans.

    Without valid weights, the plan does not change.
    """
    number, lane = wp.tid()
    nsample, plants, nact = weight_in.shape[0], plan_out.shape[1], plan_out.shape[2]
    t, p, i = plan_element(number, plants, nact)
    total = float(0.0)
    for k in range(first_row(p, nsample, plants) + lane, first_row(p + 1, nsample, plants), wp.block_dim()):
        total += weight_in[k] * action_in[t, k, i]
    total = wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)
    if lane == 0:
        plan_out[t, p, i] = wp.where(valid_in[p], total, nominal_in[t, p, i])


def value_kernel(value: wp.Function) -> wp.Kernel:
    """Make a kernel that calls a value function, ``value(obs: Row[float]) -> float``, for each sample.

    Raises:
        ValueError: The function does not take exactly one argument of type ``Row[float]``.
    """
    types = list(value.input_types.values())
    if len(types) != 1 or getattr(types[0], "ndim", 0) != 1 or types[0].dtype is not wp.float32:
        raise ValueError("a value function in Warp must be written as value(obs: Row[float]) -> float")

    @wp.kernel(module="unique", enable_backward=False)
    def values(obs_in: wp.array2d[float], value_out: wp.array[float]):
        """Evaluate the final observations of the worlds; launched over (nworld,)."""
        k = wp.tid()
        value_out[k] = value(obs_in[k])

    return values
