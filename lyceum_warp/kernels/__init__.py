"""Warp kernels and functions that belong to no single task.

``random``: counted random streams. ``state``: casts, masked copies and counters. ``faults``: what makes a
world unfit to go on. ``returns``: advantages and returns over recorded rollouts. ``recorder``: launches
recorded once and replayed.
"""
