"""MuJoCo's warnings, in the log."""

import logging

import mujoco

log = logging.getLogger(__name__)


def quiet() -> None:
    """Send MuJoCo's warnings to the log, for the whole process.

    MuJoCo itself would print each and append it to MUJOCO_LOG.TXT in the current folder, from any thread; what
    matters of them is counted per world and becomes a done reason.
    """
    mujoco.set_mju_user_warning(_log)


def _log(message: str) -> None:
    log.debug("MuJoCo: %s", message)
