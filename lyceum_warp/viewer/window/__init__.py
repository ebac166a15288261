"""The window, in a process of its own: mujoco, NumPy and studio, never torch or Warp."""
