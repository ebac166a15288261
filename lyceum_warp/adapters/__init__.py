"""Environments in the form that other libraries of reinforcement learning expect: one file a library, each an extra."""
