"""Control a world synchronously or in real time, store the trajectory, and make reports.

The *plant* is the world under control. A planner simulates its plans in separate worlds.
"""
