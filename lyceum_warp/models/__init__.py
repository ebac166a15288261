"""Help to prepare models: walking robots, rough ground, actuators."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
