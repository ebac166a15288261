"""The releases of rsl_rl that the adapter works with."""

import importlib.metadata
import importlib.util

EXTRA = "pip install 'lyceum-warp[rsl-rl]'"
"""Command that installs rsl_rl."""

_FIRST, _BEFORE = (5, 4), (6,)


def check_rsl_rl() -> None:
    """Check that rsl_rl is installed, in a release that the adapter works with.

    Raises:
        ImportError: It is not; the message says what to install.
    """
    missing = [name for name in ("rsl_rl", "tensordict") if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"rsl_rl's PPO needs {' and '.join(missing)}: {EXTRA}")
    release = _release()
    if release is not None and not _FIRST <= _numbers(release) < _BEFORE:
        raise ImportError(f"rsl-rl-lib is {release} here, but the adapter needs 5.4 or a later release of 5: {EXTRA}")


def normalizes_while_sampling() -> bool:
    """Whether PPO takes observations into its normalisers in every step; releases from 5.5 on do so in the update."""
    release = _release()
    return release is not None and _numbers(release) < (5, 5)


def _release() -> str | None:
    """The release that is installed; None for a folder with the source."""
    try:
        return importlib.metadata.version("rsl-rl-lib")
    except importlib.metadata.PackageNotFoundError:
        return None


def _numbers(release: str) -> tuple[int, ...]:
    return tuple(int(part) for part in release.split(".")[:2] if part.isdigit())
