"""Define the Warp kernels and functions that all tasks share."""
