"""Stand, walk and get up under pushes: a family of tasks for planners in real time."""

TASKS = dict.fromkeys(("humanoid_stand", "humanoid_walk", "humanoid_get_up"), "humanoid_balance")
"""The modules of the tasks, by the tasks' names; the registry reads them without running this file."""
