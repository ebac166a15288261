"""Replace files atomically, and refuse unknown file formats."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replaced(path: Path, *, durable: bool = False, previous: Path | None = None) -> Iterator[Path]:
    """Replace a file atomically: a reader finds either the old file or the complete new file.

    Write to the yielded path, a temporary file beside the target.

    Args:
        path: The file.
        durable: Whether to flush the new file to disk before the replacement, to survive a power loss.
        previous: Path under which the old file is kept; by default, the old file is lost.
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
            except OSError:  # the file system may not support hard links
                shutil.copyfile(path, previous)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None:  # the disk may be full
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text to a file atomically, in UTF-8 and without changes to its line ends."""
    with replaced(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def unknown_format(path: Path, number: Any, newest: int) -> ValueError:
    """Return the error for a file of an unknown format."""
    return ValueError(
        f"{path} has format {number!r}, and this lyceum_warp reads formats up to {newest}: "
        "pip install --upgrade lyceum-warp"
    )
