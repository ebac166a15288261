"""Adapt environments to other reinforcement learning libraries; each library is an extra."""
