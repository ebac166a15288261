"""Adapt environments to other reinforcement learning libraries. Each library is an optional extra."""
