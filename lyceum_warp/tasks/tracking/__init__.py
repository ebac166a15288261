"""Make robots follow clips: reference motions of their whole body."""

TASKS = {
    "g1": ("g1_tracking", "g1_blind_tracking"),
    "go1": ("go1_tracking",),
}
"""The names of the tasks in each module."""
