"""Control loops: one that waits for plans and one in real time; trajectories and reports.

The *plant* is the world that a controller controls. A planner simulates its plans in worlds of its own.

============================  ==========================================================================
``controller.py``             the protocols of a controller: the members that the loops use
``checked_controller.py``     a controller as the loops call it, with its results checked
``loop.py``                   ``lw.control``: the plant waits for each plan
``real_time.py``              ``lw.control_async``: the plant keeps its rate while a thread plans
``episode_collector.py``      the common part of both loops: limits, progress, the steps of the episode
``trajectory.py``             ``lw.Trajectory``: one episode, in memory and in a file
``policy_episodes.py``        episodes of a policy as trajectories, in many worlds at once
``saved_episodes.py``         files of episodes, read for playback, and an environment that shows them
``control_report.py``         ``lw.control_report``: the report on one or many trajectories
``control_statistics.py``     the statistics in that report
============================  ==========================================================================
"""
