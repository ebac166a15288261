"""Lock a run folder, so that only one process writes to it."""

import contextlib
import json
import logging
import os
import platform
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

log = logging.getLogger(__name__)

BEAT, STALE = 10.0, 120.0
"""Seconds between heartbeats, and seconds without heartbeats after which a lock is stale."""


class RunLock:
    """Locks a run within a with block. The file ``lock`` stores the process and its host.

    A daemon thread updates the lock file's modification time every 10 s. A process takes over a lock from the same host
    if the locking process is gone or the modification time is more than 120 s old. Clocks of different hosts differ, so
    a lock from another host is taken over only on request.

    Args:
        folder: The run's folder.
        take_over: Whether to take over the lock from any other process.
        note: Function that is called with a message if the lock is taken over.

    Raises:
        ValueError: Another process has the lock.
    """

    def __init__(self, folder: Path, *, take_over: bool = False, note: Callable[[str], None] = log.warning) -> None:
        self._folder, self._path, self._take_over, self._note = folder, folder / "lock", take_over, note
        pid = os.getpid()
        own = {"host": platform.node(), "pid": pid, "started": _started(pid), "token": uuid.uuid4().hex}
        self._own = json.dumps(own)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="lyceum_warp lock")

    def __enter__(self) -> "RunLock":
        with self._file("a+") as file:
            if text := file.read():
                other = _owner(text)
                reason = "on request" if self._take_over else self._free(other)
                if not reason:
                    raise ValueError(
                        f"the run in {self._folder} is being written by {_named(other)}: end this process first, or "
                        "take the run over with --take-over (take_over=True in Python)"
                    )
                self._note(f"the run in {self._folder} is taken over from {_named(other)}, {reason}")
            file.truncate(0)
            file.write(self._own)
            file.flush()
            os.utime(self._path, (time.time(),) * 2)  # use this host's time, not a file server's time
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._thread.join()
        with contextlib.suppress(OSError), self._file("r+") as file:
            if file.read() == self._own:
                self._path.unlink()

    def check(self) -> None:
        """Check that no other process has taken over the lock.

        Raises:
            ValueError: Another process has the lock.
            OSError: The lock file is gone.
        """
        with self._file("r+") as file:
            if (text := file.read()) != self._own:
                raise ValueError(f"the run in {self._folder} was taken over by {_named(_owner(text))}")

    def _free(self, other: dict[str, Any]) -> str:
        """Explain why another process's lock can be taken over; "" if it cannot be taken over."""
        if other.get("host") != platform.node():
            return ""
        if _started(other["pid"]) != other["started"]:
            return "which is gone"
        seconds = time.time() - self._path.stat().st_mtime
        return f"which has been silent for {seconds:.0f} s" if seconds > STALE else ""

    def _beat(self) -> None:
        while not self._ended.wait(BEAT):
            with contextlib.suppress(OSError), self._file("r+") as file:
                if file.read() == self._own:
                    os.utime(self._path, (time.time(),) * 2)

    @contextlib.contextmanager
    def _file(self, mode: str) -> Iterator[IO[str]]:
        """Open the lock file exclusively within the with block."""
        while True:
            with self._path.open(mode) as file:
                with contextlib.suppress(ImportError, OSError):  # Windows and some file systems have no flock
                    import fcntl

                    fcntl.flock(file, fcntl.LOCK_EX)
                if self._path.exists() and os.path.samestat(os.fstat(file.fileno()), self._path.stat()):
                    file.seek(0)
                    yield file
                    return
            # try again, because the file was deleted while this process waited


def _owner(text: str) -> dict[str, Any]:
    """Parse the process in a lock file; an empty dict if the file is damaged."""
    try:
        other = json.loads(text)
        return {"host": str(other["host"]), "pid": int(other["pid"]), "started": str(other["started"])}
    except (ValueError, TypeError, KeyError):
        return {}


def _named(owner: dict[str, Any]) -> str:
    return f"process {owner['pid']} on {owner['host']}" if owner else "another process"


def _started(pid: int) -> str:
    """Get the start time of a process, to distinguish processes with the same pid; "" if there is no process."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if state[0] == "Z" else state[19]  # a zombie process counts as ended
    except OSError:
        if Path("/proc/self/stat").exists():
            return ""
    found = subprocess.run(["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return found.stdout.strip()
