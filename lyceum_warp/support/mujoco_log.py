"""Send MuJoCo's warnings to Python's log."""

import logging

import mujoco

log = logging.getLogger(__name__)


def quiet() -> None:
    """Send MuJoCo's warnings to the log, for the whole process.

    By default, MuJoCo prints each warning and appends it to MUJOCO_LOG.TXT in the working directory.
    """
    mujoco.set_mju_user_warning(_log)


def _log(message: str) -> None:
    log.debug("MuJoCo: %s", message)
