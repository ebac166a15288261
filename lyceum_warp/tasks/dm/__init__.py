"""Reimplement dm_control's suite. Each module holds one domain."""

TASKS = {
    "dm_acrobot": ("dm/acrobot_swingup", "dm/acrobot_swingup_sparse"),
    "dm_ball_in_cup": ("dm/ball_in_cup_catch",),
    "dm_cartpole": (
        "dm/cartpole_balance",
        "dm/cartpole_balance_sparse",
        "dm/cartpole_swingup",
        "dm/cartpole_swingup_sparse",
    ),
    "dm_cheetah": ("dm/cheetah_run",),
    "dm_finger": ("dm/finger_spin", "dm/finger_turn_easy", "dm/finger_turn_hard"),
    "dm_fish": ("dm/fish_swim", "dm/fish_upright"),
    "dm_hopper": ("dm/hopper_hop", "dm/hopper_stand"),
    "dm_humanoid": ("dm/humanoid_run", "dm/humanoid_stand", "dm/humanoid_walk"),
    "dm_manipulator": ("dm/manipulator_bring_ball",),
    "dm_pendulum": ("dm/pendulum_swingup",),
    "dm_point_mass": ("dm/point_mass_easy",),
    "dm_quadruped": ("dm/quadruped_run", "dm/quadruped_walk"),
    "dm_reacher": ("dm/reacher_easy", "dm/reacher_hard"),
    "dm_swimmer": ("dm/swimmer_swimmer15", "dm/swimmer_swimmer6"),
    "dm_walker": ("dm/walker_run", "dm/walker_stand", "dm/walker_walk"),
}
"""The names of the tasks in each module."""
