"""Stand, walk and get up under pushes: a family of tasks for real-time planning."""

TASKS = {
    "g1_stand": "g1_balance",
    "g1_walk": "g1_balance",
    "humanoid_stand": "humanoid_balance",
    "humanoid_walk": "humanoid_balance",
    "humanoid_get_up": "humanoid_balance",
}
"""The module of each task, by the task's name."""
