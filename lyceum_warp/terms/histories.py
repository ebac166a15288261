"""Store the last values of a row in a ring buffer, for observation histories and delays.

To store the last n values of ``width`` numbers, declare ``past_values: Row[float] = lw.memory(1 + n * width)``.
"""

import warp as wp

from lyceum_warp.core.task import Row


@wp.func
def history_length(history: Row[float], width: int) -> int:
    """Return the number of values that a history can hold."""
    return (history.shape[0] - 1) // width


@wp.func
def push_history(history: Row[float], value: Row[float]):
    """Append a value; a full history loses its oldest value."""
    width = value.shape[0]
    length = history_length(history, width)
    pushes = int(history[0])
    for i in range(width):
        history[1 + pushes % length * width + i] = value[i]
    # at 2 n, the counter returns to n: it stays exact as a float, and the history stays full
    history[0] = float(wp.where(pushes + 1 < 2 * length, pushes + 1, length))


@wp.func
def read_history(history: Row[float], width: int, age: int, i: int) -> float:
    """Read the value with the given age, and return its element i.

    The last value has age 0, the value before it has age 1, and so on. If the history has no value of this age, the
    result is taken from its oldest value, or 0 if the history is empty.
    """
    pushes = int(history[0])
    if pushes == 0:
        return 0.0
    length = history_length(history, width)
    back = wp.min(age, wp.min(pushes, length) - 1)
    return history[1 + (pushes - 1 - back) % length * width + i]


@wp.func
def put_history(target: Row[float], history: Row[float], width: int):
    """Write all values of a history into a row of n * width numbers, the oldest first."""
    length = history_length(history, width)
    for k in range(length):
        for i in range(width):
            target[k * width + i] = read_history(history, width, length - 1 - k, i)


@wp.func
def delayed_action(action: Row[float], history: Row[float], delay: Row[float], i: int) -> float:
    """Get element i of the action that was chosen ``delay`` steps ago; call this in ``control``.

    In the first ``delay`` steps of an episode, this function uses the episode's first action. ``advance`` must append
    every action: ``terms.push_history(s1.past_actions, action)``. If the delay is longer than the history or negative,
    the result is NaN, which is a fault of the world.
    """
    age = int(delay[0])
    if age < 0 or age > history_length(history, action.shape[0]):
        return wp.nan
    if age == 0 or history[0] == 0.0:
        return action[i]
    return read_history(history, action.shape[0], age - 1, i)
