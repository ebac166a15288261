"""View worlds interactively in a browser.

``session/`` is the code of the process with torch, Warp and the worlds. ``window/`` is the code of the process with
mujoco, NumPy and studio. ``docs/architecture.md`` lists the modules.
"""
