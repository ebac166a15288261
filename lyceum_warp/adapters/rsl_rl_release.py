"""The releases of rsl_rl that the adapter works with."""

from lyceum_warp.adapters.libraries import check_library


def check_rsl_rl() -> None:
    """Check that rsl_rl is installed, in a release that the adapter works with.

    Raises:
        ImportError: It is not; the message says what to install.
    """
    check_library("rsl-rl-lib", low="5.4.2", below="6", install="lyceum-warp[rsl-rl]")
