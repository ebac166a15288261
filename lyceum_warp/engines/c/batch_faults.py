"""Count errors that MuJoCo raises in individual worlds of a batch."""

import logging
from collections.abc import Callable
from typing import Any

import mujoco
from mujoco.batch import Batch, SimulationError

log = logging.getLogger(__name__)

_COUNTED_AS = mujoco.mjtWarning.mjWARN_INERTIA.value


def call_batch(batch: Batch, method: Callable[..., object], *args: Any, **options: Any) -> None:
    """Call a method of a batch, and turn errors of individual worlds into warnings, so that ``find_faults`` finds them.

    After an error in a world, MuJoCo restores the state that the world had before the call. It steps the other worlds.
    """
    try:
        method(*args, **options)
    except SimulationError as error:
        log.debug("MuJoCo: %s", error)
        batch.warning[error.ids, _COUNTED_AS, 1] += 1
