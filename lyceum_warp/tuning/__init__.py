"""Find physics options that are faster and do not change the returns: `lw.tune`."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
