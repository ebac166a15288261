"""Show frames and handle input, with mujoco, NumPy and studio, but without torch or Warp."""
