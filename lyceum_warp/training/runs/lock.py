"""Lock a run folder, so that only one process writes to it."""

import contextlib
import fcntl
import json
import os
import platform
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path


@contextlib.contextmanager
def run_lock(folder: Path, *, take_over: bool = False) -> Iterator[Callable[[], None]]:
    """Lock a run in a ``with`` block. The file ``lock`` stores the process and its host.

    The process locks this file by flock. The system releases the lock when the process ends, even after ``kill -9``.
    On some network file systems, other hosts do not see the lock. A lock file that names another host therefore counts
    as locked. On file systems without flock, every lock file counts as locked until it is deleted.

    Yields:
        A function that raises ValueError if another process has taken over the lock, or OSError if the lock file is
        gone.

    Raises:
        ValueError: Another process has the lock.
    """
    path, here = folder / "lock", platform.node()
    mark = json.dumps({"host": here, "pid": os.getpid(), "token": uuid.uuid4().hex})

    def check() -> None:
        if (text := path.read_text()) != mark:
            raise ValueError(f"the run in {folder} was taken over by {_owner(text)[0]}")

    if take_over:
        path.unlink(missing_ok=True)
    while True:
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                held = False
            except BlockingIOError:
                held = True
            except OSError:  # some file systems have no flock
                held = os.path.getsize(path) > 0
            file.seek(0)
            text = file.read()
            if held or (text and _owner(text)[1] != here):
                raise ValueError(
                    f"the run in {folder} is being written by {_owner(text)[0]}: end that process first, or take the "
                    "run over with --take-over (take_over=True in Python)"
                )
            if not path.exists() or not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                continue  # another process has deleted or replaced the file since it was opened
            file.truncate(0)
            file.write(mark)
            file.flush()
            try:
                yield check
            finally:
                with contextlib.suppress(OSError, ValueError):
                    check()
                    path.unlink()
            return


def _owner(text: str) -> tuple[str, str]:
    """Describe the process in a lock file, and return its host."""
    try:
        owner = json.loads(text)
        return f"process {owner['pid']} on {owner['host']}", str(owner["host"])
    except (ValueError, TypeError, KeyError):
        return "another process", ""
