"""Stand, walk and get up under pushes: a family of tasks for real-time planning."""

TASKS = {
    "g1_balance": ("g1_stand", "g1_walk"),
    "humanoid_balance": ("humanoid_stand", "humanoid_walk", "humanoid_get_up"),
}
"""The names of the tasks in each module."""
