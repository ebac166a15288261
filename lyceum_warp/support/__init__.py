"""Provide helpers that use no other part of the package."""
