"""Run the Warp engine: MuJoCo Warp on a CUDA device or on the CPU."""
