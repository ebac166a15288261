"""Adapt environments to other reinforcement learning libraries, which are optional extras."""
