"""Algorithms that learn and plan, and the parts that they are made of.

``npg.py``, ``ppo.py`` and ``planner.py`` each hold one algorithm, in the order of its mathematics. None touches the
arrays behind an environment: NPG and PPO use ``Env``; the planner also uses ``OpenLoop``, to whose phases it adds its
own.

What learners share: ``learner`` (what training needs of them), ``rollout_buffer`` (samples), ``policy``, ``value`` and
``networks`` (the functions that are learned), ``policy_check`` (checks of given ones), ``evaluation`` (the mean policy
in whole episodes), ``on_policy`` (statistics of episodes), ``distributed`` (several processes) and ``timing`` (seconds
of phases).

NPG's parts: ``npg_config`` (hyperparameters), ``natural_gradient`` (Fisher information and conjugate gradient),
``dense`` (networks on the CPU, with derivatives written out), ``value_fit`` (regression on returns) and
``npg_statistics`` (the numbers of an iteration).

PPO's parts: ``ppo_config`` (hyperparameters) and ``minibatches`` (epochs; on a GPU, each is one CUDA graph).

The planner's parts: ``plan_update`` (the contract of an update), ``mppi``, ``cem`` and ``predictive_sampling`` (three
updates), ``mppi_config`` (settings), ``mppi_arguments`` (the arguments of a planner, sorted into settings, options and
parameters) and ``planner_state`` (the state to plan from).
"""
