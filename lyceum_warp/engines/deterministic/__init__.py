"""The deterministic mode of the Warp engine on CUDA devices."""
