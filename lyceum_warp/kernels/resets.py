"""Make the kernels of a reset, which begin episodes and start random streams."""

import warp as wp

from lyceum_warp.kernels.random import stream
from lyceum_warp.kernels.step_types import Counters, TaskCode

STARTUP = wp.constant(-1)
"""Replaces the episode number in the random stream of ``startup``."""

OBJECT = wp.constant(-2)
"""Replaces the step in the random stream from which an episode's object is drawn."""


@wp.kernel(enable_backward=False)
def assign_objects(mask_in: wp.array[bool], index_in: wp.array[float], world: int, object_out: wp.array2d[float]):
    """Give the masked worlds objects in turn, beginning with that of ``world``; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        object_out[w, 0] = index_in[(world + w) % index_in.shape[0]]


@wp.kernel(enable_backward=False)
def choose_objects(
    mask_in: wp.array[bool], index_in: wp.array[float], random: bool, counters: Counters, object_out: wp.array2d[float],
    first: int,
):  # fmt: skip
    """Draw the objects of the masked worlds' next episodes, or choose the first object; launched over (nworld,)."""
    w = first + wp.tid()
    if mask_in[w]:
        state = stream(counters.key[w], counters.episode[w] + 1, OBJECT)
        object_out[w, 0] = index_in[wp.where(random, wp.randi(state, 0, index_in.shape[0]), 0)]


@wp.kernel(enable_backward=False)
def take_nominal(
    mask_in: wp.array[bool], object_in: wp.array2d[float], nominal_in: wp.array2d[float], target_out: wp.array2d[float],
    lanes: int, first: int,
):  # fmt: skip
    """Copy the nominal rows of the masked worlds' objects; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        row = wp.clamp(int(object_in[w, 0]), 0, nominal_in.shape[0] - 1)
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = nominal_in[row, i]


def make_reset_kernels(task: TaskCode) -> None:
    @task.kernel_for("startup")
    def start_worlds(mask_in: wp.array[bool], t: task.Transition, first: int):
        """Call ``startup`` in the masked worlds; launched over (nworld,)."""
        w = first + wp.tid()
        if mask_in[w]:
            t.counters.rng[w, 0] = stream(t.counters.key[w], STARTUP, 0)
            task.functions.startup(task.view(t.after, w), task.params_of(t, w), t.counters.rng[w])

    @task.kernel()
    def restart(mask_in: wp.array[bool], random: bool, again: bool, t: task.Transition, first: int):
        """Begin an episode in the masked worlds, or draw another initial state; launched over (nworld,).

        The engine has already reset these worlds to the fixed initial state. Another initial state is drawn with the
        next numbers of the world's random stream.
        """
        w = first + wp.tid()
        if not mask_in[w]:
            return
        if not again:
            t.counters.step[w] = 0
            t.counters.episode[w] = t.counters.episode[w] + 1
            t.counters.rng[w, 0] = stream(t.counters.key[w], t.counters.episode[w], 0)
        s, p = task.view(t.after, w), task.params_of(t, w)
        task.functions.initialize(s, p)
        if random:
            task.functions.randomize(s, p, t.counters.rng[w])

    @task.kernel_for("reject")
    def reject_worlds(
        mask_in: wp.array[bool], batch: task.Batch, params: wp.array[task.Params], again_out: wp.array[bool], first: int
    ):
        """Find the masked worlds whose initial states are rejected; launched over (nworld,)."""
        w = first + wp.tid()
        again_out[w] = mask_in[w] and task.functions.reject(task.view(batch, w), params[w % params.shape[0]])
