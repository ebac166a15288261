"""Provide helpers that depend on no other room."""
