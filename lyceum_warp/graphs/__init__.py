"""Capture and replay Warp launches, and compile their kernels ahead of time."""
