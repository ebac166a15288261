"""Files that are replaced whole, and formats that a newer release may have changed."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced(path: Path, *, durable: bool = False, previous: Path | None = None) -> Iterator[Path]:
    """Replace a file in one go: a reader finds the old file or the whole new one.

    The block writes into the path that it is given, a temporary file beside the target. If the block raises, the target
    stays as it is and the temporary file is deleted.

    Args:
        path: The file.
        durable: Whether the new content must reach the disk before the old file is given up, for a loss of power.
        previous: Where the old file is kept, in place of another one. It exists under ``path``, too, until the end.
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        yield temporary
        if durable:
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
        if previous is not None and path.exists():
            previous.unlink(missing_ok=True)
            try:
                os.link(path, previous)
            except OSError:  # a file system without links
                _moved(path, previous)
        _moved(temporary, path)
    except OSError as error:
        if error.filename is None:  # as on a full disk
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _moved(source: Path, target: Path) -> None:
    """Move a file, with a second attempt: on a network or while another program reads the file, one may fail."""
    try:
        os.replace(source, target)
    except OSError:
        time.sleep(0.1)
        os.replace(source, target)


def newer_format(path: Path, number: int, known: int) -> ValueError:
    """The error for a file that a newer release wrote.

    Args:
        path: The file.
        number: Its format.
        known: The newest format that this release can read.
    """
    return ValueError(
        f"{path} was written by a newer lyceum_warp (format {number}, this one reads up to {known}): "
        "pip install --upgrade lyceum-warp"
    )
