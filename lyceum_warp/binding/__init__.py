"""Find tasks, and bind them to their compiled models and kernels."""
