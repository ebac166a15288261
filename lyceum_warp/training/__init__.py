"""Train a learner, and write and read its run's folder."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
