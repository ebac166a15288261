"""Make hands turn objects: spin them, or turn them to goals."""

TASKS = {"leap": ("leap_rotate", "leap_reorient", "leap_objects")}
"""The names of the tasks in each module."""
