"""Make plots, render videos, and write curves for TensorBoard.

Plots and videos need the extra ``viz``.
"""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
