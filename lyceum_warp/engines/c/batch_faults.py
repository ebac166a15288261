"""Count errors that MuJoCo raises in individual worlds of a batch."""

import logging

import mujoco
from mujoco.batch import Batch, SimulationError

log = logging.getLogger(__name__)

_COUNTED_AS = mujoco.mjtWarning.mjWARN_INERTIA.value


class ErrorsAsWarnings:
    """A context manager that turns errors of individual worlds into warnings, so that ``find_faults`` finds them.

    After an error in a world, MuJoCo restores the world's state before the call, and steps the other worlds. All steps
    share one instance, because a generator-based context manager takes four times as long to enter.
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
