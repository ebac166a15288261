"""Stand, walk and get up under pushes: a family of tasks for planners in real time."""

TASKS = {"humanoid_stand": "humanoid", "humanoid_walk": "humanoid", "humanoid_get_up": "humanoid"}
"""The modules of the tasks, by the tasks' names; the registry reads them without running this file."""
