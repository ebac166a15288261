"""Physics behind one contract: the C engine (mujoco.batch) and the Warp engine (mujoco_warp)."""
