"""Count errors that MuJoCo raises in individual worlds of a batch."""

import logging

import mujoco
from mujoco.batch import Batch, SimulationError

log = logging.getLogger(__name__)

_COUNTED_AS = mujoco.mjtWarning.mjWARN_INERTIA.value
"""Errors are counted as this type of warning."""


class ErrorsAsWarnings:
    """Context that counts errors of individual worlds as warnings, for ``find_faults``, instead of raising them.

    After an error MuJoCo restores the world's state from before the call, and finishes the other worlds. This is a
    class, and all steps share one instance, because entering a generator-based context takes four times as long.

    Args:
        batch: The worlds.
    """

    def __init__(self, batch: Batch) -> None:
        self._batch = batch

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, SimulationError):
            return False
        log.debug("MuJoCo: %s", error)
        self._batch.warning[error.ids, _COUNTED_AS, 1] += 1
        return True
