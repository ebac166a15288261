"""Check that the packages of an extra are installed."""

import importlib.util


def check_extra(purpose: str, extra: str, *packages: str) -> None:
    """Check that packages are installed, by default the package with the extra's name.

    Raises:
        ImportError: A package is missing. The message names the packages and the extra.
    """
    if missing := [name for name in packages or (extra,) if importlib.util.find_spec(name) is None]:
        raise ImportError(f"{purpose} needs {' and '.join(missing)}: pip install 'lyceum-warp[{extra}]'")
