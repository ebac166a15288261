"""Batched MuJoCo worlds for robot learning: one task source, two engines, arrays shared with torch.

Importing the package loads neither torch nor Warp nor MuJoCo: each public name loads its module at its first use.
"""

from lyceum_warp.support.faces import face

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = face(__name__)
