"""Control one world synchronously or in real time, store its trajectory, and make reports.

The *plant* is the world under control.
"""
