"""Initialise Warp without a banner, and log its messages about the CUDA driver."""

import contextlib
import logging
import os
import sys
import tempfile
import threading

import warp as wp

log = logging.getLogger(__name__)

_REMARKS = ("Warp CUDA warning: ", "Warp CUDA error: Warp requires CUDA driver ")
_lock = threading.Lock()
_remarks: list[str] | None = None


def start_warp() -> list[str]:
    """Initialise Warp without a banner, and log its messages about the CUDA driver.

    By default, Warp prints a banner and a line for every loaded module. The log level is therefore raised to warnings,
    unless the user has set it. Without a GPU, Warp's native library prints messages about the driver to stderr. These
    messages are logged instead.

    Returns:
        The messages about the CUDA driver, which callers add to errors about a missing device.
    """
    global _remarks
    with _lock:
        if _remarks is None:
            level = wp.LOG_WARNING if wp.config.log_level == wp.LOG_INFO else wp.config.log_level
            wp.config.log_level = max(level, wp.LOG_ERROR)  # Warp would print one of these messages again
            try:
                printed = _stderr_of_start()
            finally:
                wp.config.log_level = level
            _remarks = [line for line in printed if line.startswith(_REMARKS)]
            for line in _remarks:
                log.info("%s", line)
            if others := [line for line in printed if not line.startswith(_REMARKS)]:
                print(*others, sep="\n", file=sys.stderr)
        return _remarks


def _stderr_of_start() -> list[str]:
    """Initialise Warp, and return the lines that it writes to stderr."""
    with contextlib.ExitStack() as restored:
        try:
            stderr = os.dup(2)
        except OSError:  # stderr may be closed, as under pythonw
            wp.init()
            return []
        restored.callback(os.close, stderr)
        file = restored.enter_context(tempfile.TemporaryFile())
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(file.fileno(), 2)
        try:
            wp.init()
        finally:
            if sys.stderr is not None:
                sys.stderr.flush()
            os.dup2(stderr, 2)
        file.seek(0)
        return file.read().decode(errors="replace").splitlines()
