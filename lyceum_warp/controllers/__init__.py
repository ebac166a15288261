"""Control one world synchronously or in real time, store its trajectory, and make reports.

The *plant* is the world under control.
"""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
