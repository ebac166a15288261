"""Check that a supported release of an adapter's library is installed."""

import importlib.metadata
import re


def check_library(package: str, *, low: str, below: str, install: str) -> None:
    """Raise an ImportError unless a supported release of a library is installed."""
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
