"""The window: a process of its own that draws, with mujoco and NumPy, without torch and Warp."""
