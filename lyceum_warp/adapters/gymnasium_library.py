"""Gymnasium in a version that the adapters know: they import it from here, so that the check comes first."""

from lyceum_warp.adapters.libraries import check_library

check_library("gymnasium", low="1.1", below="2", install="gymnasium>=1.1,<2")

import gymnasium  # noqa: E402 (after the check)
import gymnasium.vector.utils  # noqa: E402

__all__ = ["gymnasium"]
