"""The interactive viewer, in a browser or in a window.

==================  =====================================================================================
``protocol.py``     what a session and a window exchange: scene, frames, commands
``view.py``         ``lw.view``: a session and its window
``session.py``      the loop that steps, obeys commands and shows frames
``frames.py``       frames: poses, ghosts, curves and messages
``live.py``         the worlds that are stepped, their past, and copies of the rows that are shown
``controllers.py``  policies of all worlds, and controllers of one world, whose plans can be looked at
``traces.py``       the paths of a planner's samples, in worlds and a thread of their own
``playback.py``     episodes that are played back
``follow.py``       the newest policy of a training run; ``lw.RunViewer``
``videos.py``       videos of what is shown
``window.py``       the window's process, seen from the session; ``window_process.py``, the process itself
``link.py``         their messages
``panel.py``        the panel, its keys, and what the mouse does
``studio.py``       all contact with mujoco.studio
``front.py``        the server that checks every request of a browser
``curves.py``, ``extra_geoms.py``, ``model_values.py``    parts of the panel: curves, ghosts, model fields
==================  =====================================================================================
"""
