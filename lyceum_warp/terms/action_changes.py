"""Compute reward terms for the change of actions between steps.

A task's ``advance`` stores earlier actions in memory, which terms and observations read from ``s1``::

    lw.put(s1.earlier_action, 0, s0.previous_action)
    lw.put(s1.previous_action, 0, s0.last_action)
    lw.put(s1.last_action, 0, action)
"""

import warp as wp

from lyceum_warp.core.task import Row


@wp.func
def action_rate_l2(action: Row[float], previous_action: Row[float]) -> float:
    """The sum of (a_t - a_{t-1})^2.

    Source: mjlab 1.6.0, ``action_rate_l2``.
    """
    total = float(0.0)
    for i in range(action.shape[0]):
        change = action[i] - previous_action[i]
        total += change * change
    return total


@wp.func
def action_acceleration_l2(action: Row[float], previous_action: Row[float], earlier_action: Row[float]) -> float:
    """The sum of (a_t - 2 a_{t-1} + a_{t-2})^2.

    Source: mjlab 1.6.0, ``action_acc_l2``.
    """
    total = float(0.0)
    for i in range(action.shape[0]):
        change = action[i] - 2.0 * previous_action[i] + earlier_action[i]
        total += change * change
    return total
