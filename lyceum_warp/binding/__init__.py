"""From a task's functions and model to kernels and a compiled model; the registry of tasks."""
