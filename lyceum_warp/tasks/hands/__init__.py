"""Make hands turn objects: spin them, or turn them to goals."""

TASKS = {"leap": ("leap_rotate", "leap_reorient")}
"""The names of the tasks in each module."""
