"""Control worlds, synchronously or in real time; record trajectories and make reports.

The *plant* is the world under control. A planner simulates its plans in worlds of its own.
"""
