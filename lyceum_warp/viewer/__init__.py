"""View worlds interactively in a browser.

``session/`` is the code of the process with torch, Warp and the worlds. ``window/`` is the code of the process with
mujoco, NumPy and studio. ``docs/architecture.md`` lists the modules.
"""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
