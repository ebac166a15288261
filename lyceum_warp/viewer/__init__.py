"""The interactive viewer, in a browser or in a window: two processes, a folder for each.

=================  ====================================================================================================
``show.py``        ``lw.view``: open a session and its window
``follow.py``      follow a training run: its newest policy; ``lw.RunViewer``
``protocol.py``    the messages between both processes: scene, frames, commands
``session/``       this process: torch, Warp and the worlds. ``clock.py`` loops; ``commands.py`` carries out commands;
                   ``stage.py`` holds what is shown; ``plant.py`` runs a planner's plant in real time; ``live.py`` steps
                   worlds and keeps their past; ``drivers.py`` calls controllers; ``playback.py``, ``frames.py``,
                   ``traces.py`` and ``videos.py``; ``window_process.py`` starts and feeds the other process
``window/``        the other process: mujoco, NumPy and studio, never torch or Warp. ``main.py`` is its entry;
                   ``panel.py`` shows frames; ``windows.py`` draws the ImGui windows; ``actions.py`` has the keys;
                   ``mouse.py`` pushes bodies; ``scene.py`` draws ghosts and traces; ``studio.py`` is all contact with
                   mujoco.studio; ``proxy.py`` and ``sockets.py`` guard the page
=================  ====================================================================================================
"""
