"""Warp kernels and functions that belong to no single task.

``steps``: the kernels of a step, made around a task's functions. ``state``: casts, masked copies and counters.
``faults``: faults of worlds, as bits. ``random``: counted random streams. ``rotations``: quaternions. ``planning``:
noise, weights and plans of MPPI. ``collect``: the rollout buffer of NPG. ``returns``: advantages and returns.
"""
