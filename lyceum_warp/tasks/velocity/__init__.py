"""Make legged robots walk at a commanded velocity."""

TASKS = {
    "go1": ("go1_velocity",),
    "go1_rough": ("go1_rough_velocity",),
    "student": ("go1_student_velocity",),
    "spot": ("spot_velocity",),
    "g1": ("g1_velocity", "g1_full_velocity"),
    "g1_rough": ("g1_rough_velocity",),
    "h1": ("h1_velocity",),
    "t1": ("t1_velocity",),
}
"""The names of the tasks in each module."""
