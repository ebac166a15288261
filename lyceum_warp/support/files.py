"""Replace files atomically, and report file formats of newer releases."""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced(path: Path, *, durable: bool = False, previous: Path | None = None) -> Iterator[Path]:
    """Replace a file atomically: a reader finds the old file or the complete new one.

    The block writes to the yielded path, a temporary file beside the target. If the block raises, the target stays
    unchanged and the temporary file is deleted.

    Args:
        path: The file.
        durable: Whether to flush the new content to disk before replacing the old file, in case of a power loss.
        previous: Where to save the old file; by default it is lost.
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
            except OSError:  # a file system without hard links
                shutil.copyfile(path, previous)
        try:
            os.replace(temporary, path)
        except OSError:  # on a network drive, or while another program reads the file
            time.sleep(0.1)
            os.replace(temporary, path)
    except OSError as error:
        if error.filename is None:  # for instance on a full disk
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def newer_format(path: Path, number: int, known: int) -> ValueError:
    """The error for a file that a newer release wrote.

    Args:
        path: The file.
        number: The format number in the file.
        known: The newest format that this release can read.
    """
    return ValueError(
        f"{path} was written by a newer lyceum_warp (format {number}, this one reads up to {known}): "
        "pip install --upgrade lyceum-warp"
    )
