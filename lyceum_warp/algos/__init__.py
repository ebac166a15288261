"""Learn by NPG, PPO or SAC, and plan by sampling."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
