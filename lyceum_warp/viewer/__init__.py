"""View worlds interactively in a browser, with two processes that have a folder each.

=================  ====================================================================================================
``show.py``        ``lw.view``: open a session and its window
``follow.py``      ``lw.RunViewer``: follow a training run
``protocol.py``    messages between the processes: scene, frames, commands
``session/``       the process with torch, Warp and the worlds. ``clock.py`` has the main loop; ``commands.py`` carries
                   out commands; ``stage.py`` holds the mode, controller and worlds; ``live.py`` steps worlds and
                   keeps their history; ``plant.py`` runs a planner in real time; ``drivers.py`` calls controllers;
                   ``playback.py`` plays back episodes; ``frames.py``, ``traces.py`` and ``videos.py`` make frames,
                   traces and videos; ``driving.py`` and ``live_settings.py`` change commands and numbers;
                   ``window_process.py`` starts the other process
``window/``        the process with mujoco, NumPy and studio. ``main.py`` is its entry point; ``panel.py`` connects
                   studio with the session; ``windows.py`` draws the ImGui windows; ``actions.py`` has the keys;
                   ``mouse.py`` pushes bodies; ``scene.py`` draws ghosts and traces; ``studio.py`` wraps mujoco.studio;
                   ``proxy.py`` and ``sockets.py`` guard the page
=================  ====================================================================================================
"""
