"""Simulate physics behind one interface: the C engine (mujoco.batch) and the Warp engine (mujoco_warp)."""
