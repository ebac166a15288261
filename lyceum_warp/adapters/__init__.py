"""Adapt environments to other reinforcement learning libraries, which are optional extras."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
