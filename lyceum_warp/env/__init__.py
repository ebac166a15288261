"""Run one task in many worlds: environments, open-loop rollouts, curricula."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
