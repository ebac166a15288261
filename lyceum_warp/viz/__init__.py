"""Plots and videos. They need the extra ``viz``."""

EXTRA = "pip install 'lyceum-warp[viz]'"
"""Command that installs the packages for plots and videos."""
