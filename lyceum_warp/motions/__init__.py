"""Read, resample, check and edit reference motions, and compute a task's tables from them."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
