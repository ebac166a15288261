"""Make the Warp engine deterministic on CUDA devices."""
