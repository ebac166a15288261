"""Checks of the libraries that the adapters need."""

import importlib.metadata
import re


def check_library(package: str, *, low: str, below: str, install: str) -> None:
    """Check that a package is installed, in a version that its adapter was written for.

    Args:
        package: The package as pip names it.
        low: The lowest version that fits, as "2.9".
        below: The first version that is too new, as "3".
        install: What pip installs to get a fitting version.

    Raises:
        ImportError: It is not installed, or in another version.
    """
    try:
        found = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        raise ImportError(f"this adapter needs the package {package}: pip install '{install}'") from None
    if not _numbers(low) <= _numbers(found) < _numbers(below):
        raise ImportError(
            f"this adapter needs {package} from {low} to below {below}, and {found} is installed: "
            f"pip install '{install}'"
        )


def _numbers(version: str) -> tuple[int, ...]:
    """The release of a version: (2, 10) for "2.10rc1"."""
    return tuple(map(int, re.findall(r"\d+", re.match(r"[\d.]*", version).group())))  # type: ignore[union-attr]
