"""Compute advantages and returns of rollouts: one thread per world processes its steps backwards."""

import warp as wp


@wp.kernel(enable_backward=False)
def advantages(
    reward_in: wp.array2d[float],
    value_in: wp.array2d[float],
    next_value_in: wp.array2d[float],
    terminated_in: wp.array2d[bool],
    done_in: wp.array2d[bool],
    gamma: float,
    lam: float,
    advantage_out: wp.array2d[float],
    return_out: wp.array2d[float],
):
    """Compute advantages and discounted returns, (steps, nworld); launched over (nworld,).

    Advantages are generalised advantage estimates (Schulman et al. 2016, "High-dimensional continuous control using
    generalized advantage estimation", eq. 16). ``next_value`` is the value of the state after a step, before any reset.
    If the time limit or the end of the rollout truncates an episode, ``next_value`` replaces the missing rewards. After
    a termination, there are no more rewards.
    """
    w = wp.tid()
    last = reward_in.shape[0] - 1
    advantage = float(0.0)
    rest = next_value_in[last, w]
    for i in range(last + 1):
        t = last - i
        next_value = next_value_in[t, w]
        if done_in[t, w]:
            advantage = 0.0
            rest = next_value
        if terminated_in[t, w]:
            next_value = 0.0
            rest = 0.0
        rest = reward_in[t, w] + gamma * rest
        advantage = reward_in[t, w] + gamma * next_value - value_in[t, w] + gamma * lam * advantage
        advantage_out[t, w] = advantage
        return_out[t, w] = rest
