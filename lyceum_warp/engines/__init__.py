"""Simulate physics behind one interface: the C engine (mujoco.batch) and the Warp engine (mujoco_warp)."""

from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)
