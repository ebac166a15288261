"""Algorithms that learn and plan, and the parts that they are made of.

``npg.py`` and ``mppi.py`` each hold one algorithm, in the order of its mathematics. Both reach the worlds only through
the public interface of the environment and of its open-loop roll-outs.

NPG's parts: ``npg_config`` (hyperparameters), ``rollout_buffer`` (samples), ``natural_gradient`` (Fisher information
and conjugate gradient), ``policy``, ``value`` and ``networks`` (the functions that are learned), ``value_fit``
(regression on returns), ``evaluation`` (the mean policy in whole episodes), ``statistics`` (the numbers of an
iteration), ``distributed`` (several processes) and ``timing``.
"""
