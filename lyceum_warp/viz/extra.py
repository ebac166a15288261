"""Define the error for a machine that cannot render, and the extra that installs packages for plots and videos."""

EXTRA = "pip install 'lyceum-warp[viz]'"
"""The command that installs the packages for plots and videos."""


class NoVideoError(RuntimeError):
    """Raised if the machine cannot render, or if a package for videos is missing. The message says how to fix it."""
