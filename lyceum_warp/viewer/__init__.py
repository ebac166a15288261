"""View worlds interactively in a browser.

The viewer has two processes, and the code of each process has its own folder.

- ``show.py`` opens a session and its window: ``lw.view``.
- ``follow.py`` follows a training run: ``lw.RunViewer``.
- ``protocol.py`` defines the messages between the processes.
- ``session/`` is the process with torch, Warp and the worlds. ``clock.py`` has the main loop. ``commands.py`` carries
  out commands. ``stage.py`` holds the mode, the controller and the worlds. ``live.py`` steps worlds and keeps their
  history. ``plant.py`` runs a planner in real time. ``drivers.py`` calls controllers. ``playback.py`` plays back
  episodes. ``frames.py``, ``traces.py`` and ``videos.py`` make frames, traces and videos. ``driving.py`` changes a
  walking robot's command. ``live_settings.py`` changes settings and parameters. ``window_process.py`` starts the
  window process.
- ``window/`` is the process with mujoco, NumPy and studio. ``main.py`` is its entry point. ``panel.py`` connects studio
  with the session. ``windows.py`` draws the ImGui windows, ``actions.py`` has the keys, and ``mouse.py`` pushes bodies.
  ``scene.py`` draws ghosts and traces. ``studio.py`` wraps mujoco.studio. ``proxy.py`` and ``sockets.py`` control the
  access to the page.
"""
