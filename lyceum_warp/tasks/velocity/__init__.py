"""Make legged robots walk at a commanded velocity."""

TASKS = {
    "go1_velocity": "go1",
    "go1_rough_velocity": "go1_rough",
    "go1_student_velocity": "student",
    "spot_velocity": "spot",
    "g1_velocity": "g1",
    "g1_full_velocity": "g1",
    "g1_rough_velocity": "g1_rough",
    "h1_velocity": "h1",
    "t1_velocity": "t1",
}
"""The module of each task, by the task's name."""
