"""Errors that MuJoCo raises in single worlds of a batch."""

import contextlib
import logging
from collections.abc import Iterator

import mujoco
from mujoco.batch import Batch, SimulationError

log = logging.getLogger(__name__)

_COUNTED_AS = mujoco.mjtWarning.mjWARN_INERTIA.value
"""The kind of warning under which errors are counted; no other done reason stands for it."""


@contextlib.contextmanager
def errors_as_warnings(batch: Batch) -> Iterator[None]:
    """Count errors of single worlds as warnings, which ``find_faults`` reads, instead of raising them.

    MuJoCo leaves a world with an error in the state that it had before the call, and finishes the others.
    """
    try:
        yield
    except SimulationError as error:
        log.debug("MuJoCo: %s", error)
        batch.warning[error.ids, _COUNTED_AS, 1] += 1
