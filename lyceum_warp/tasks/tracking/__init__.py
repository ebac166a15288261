"""Make robots follow clips: reference motions of their whole body."""

TASKS = {
    "g1_tracking": "g1",
    "g1_blind_tracking": "g1",
    "go1_tracking": "go1",
}
"""The module of each task, by the task's name."""
