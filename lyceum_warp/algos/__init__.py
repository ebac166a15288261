"""Algorithms that learn and plan, and the parts that they are made of.

``npg.py`` and ``planner.py`` each hold one algorithm, in the order of its mathematics. Neither touches the arrays
behind an environment: NPG uses ``Env``, and the planner also uses ``OpenLoop``, to whose phases it adds its own.

NPG's parts: ``npg_config`` (hyperparameters), ``rollout_buffer`` (samples), ``natural_gradient`` (Fisher information
and conjugate gradient), ``policy``, ``value`` and ``networks`` (the functions that are learned), ``dense`` (the same on
the CPU, with derivatives written out), ``value_fit`` (regression on returns), ``evaluation`` (the mean policy in whole
episodes), ``npg_statistics`` (the numbers of an iteration), ``distributed`` (several processes) and ``timing`` (seconds
of its phases).

The planner's parts: ``plan_update`` (the contract of an update), ``mppi``, ``cem`` and ``predictive_sampling`` (three
updates), ``mppi_config`` (settings), ``mppi_arguments`` (the arguments of a planner, sorted into settings, options and
parameters) and ``planner_state`` (the state to plan from).
"""
