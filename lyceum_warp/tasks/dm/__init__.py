"""Reimplement dm_control's suite: a family of tasks with one domain in each module."""

TASKS = {
    "dm/acrobot_swingup": "dm_acrobot",
    "dm/acrobot_swingup_sparse": "dm_acrobot",
    "dm/ball_in_cup_catch": "dm_ball_in_cup",
    "dm/cartpole_balance": "dm_cartpole",
    "dm/cartpole_balance_sparse": "dm_cartpole",
    "dm/cartpole_swingup": "dm_cartpole",
    "dm/cartpole_swingup_sparse": "dm_cartpole",
    "dm/cheetah_run": "dm_cheetah",
    "dm/finger_spin": "dm_finger",
    "dm/finger_turn_easy": "dm_finger",
    "dm/finger_turn_hard": "dm_finger",
    "dm/hopper_hop": "dm_hopper",
    "dm/hopper_stand": "dm_hopper",
    "dm/humanoid_run": "dm_humanoid",
    "dm/humanoid_stand": "dm_humanoid",
    "dm/humanoid_walk": "dm_humanoid",
    "dm/pendulum_swingup": "dm_pendulum",
    "dm/point_mass_easy": "dm_point_mass",
    "dm/reacher_easy": "dm_reacher",
    "dm/reacher_hard": "dm_reacher",
    "dm/walker_run": "dm_walker",
    "dm/walker_stand": "dm_walker",
    "dm/walker_walk": "dm_walker",
}
"""The modules of the tasks, by the tasks' names; the registry reads them without running this file."""
