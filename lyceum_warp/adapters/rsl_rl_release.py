"""The releases of rsl_rl that the adapter works with."""

import importlib.metadata

from lyceum_warp.adapters.libraries import check_library


def check_rsl_rl() -> None:
    """Check that rsl_rl is installed, in a release that the adapter works with.

    Raises:
        ImportError: It is not; the message says what to install.
    """
    check_library("rsl-rl-lib", low="5.4.2", below="6", install="lyceum-warp[rsl-rl]")


def normalizes_while_sampling() -> bool:
    """Whether PPO takes observations into its normalisers in every step; releases from 5.5 on do so in the update."""
    return importlib.metadata.version("rsl-rl-lib").startswith("5.4.")
