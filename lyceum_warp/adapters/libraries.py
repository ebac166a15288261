"""Check that a supported release of an adapter's library is installed."""

import importlib.metadata
import re


def check_library(package: str, *, low: str, below: str, install: str) -> None:
    """Check the installed release of a library.

    Args:
        package: The package's name for pip.
        low: The lowest supported version, such as "2.9".
        below: The first newer version that is not supported, such as "3".
        install: The argument of ``pip install`` that installs a supported release.

    Raises:
        ImportError: The library is missing, or its release is not supported.
    """
    try:
        found = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        raise ImportError(f"this adapter needs the package {package}: pip install '{install}'") from None
    if not _release(low) <= _release(found) < _release(below):
        raise ImportError(
            f"this adapter needs {package} from {low} to below {below}, and {found} is installed: "
            f"pip install '{install}'"
        )


def _release(version: str) -> tuple[int, ...]:
    """Return the numbers of a version: (2, 10) for "2.10rc1"."""
    return tuple(map(int, re.findall(r"\d+", re.match(r"[\d.]*", version).group())))  # type: ignore[union-attr]
