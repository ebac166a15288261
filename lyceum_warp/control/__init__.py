"""Controllers at work: the loop that waits for plans, the loop against the clock, trajectories and reports.

The *plant* is the world that a controller controls. A planner simulates its plans in worlds of its own.

============================  ==========================================================================
``controller.py``             the protocols of a controller: what the loops call, and what they use
``checked_controller.py``     a controller as the loops call it, with its results checked
``loop.py``                   ``lw.control``: the plant waits for each plan
``real_time.py``              ``lw.control_async``: the plant keeps its rate while a thread plans
``episode_collector.py``      what both loops share: limits, progress, the steps of the episode
``trajectory.py``             ``lw.Trajectory``: one episode, in memory and in a file
``control_report.py``         ``lw.control_report``: the report on one or many trajectories
``control_statistics.py``     the statistics in that report
============================  ==========================================================================
"""
