"""The deterministic mode of the Warp engine on CUDA devices. No other room needs this one."""
