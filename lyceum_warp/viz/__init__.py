"""Draw plots and videos, which need the extra ``viz``, and write curves for TensorBoard."""

EXTRA = "pip install 'lyceum-warp[viz]'"
"""Command that installs the packages for plots and videos."""


class NoVideoError(RuntimeError):
    """The machine cannot draw, or lacks a package for videos. The message names it and the fix."""
