"""Find tasks, and bind them to their compiled models and kernels."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
