"""Algorithms: each knows Env and nothing below it."""
