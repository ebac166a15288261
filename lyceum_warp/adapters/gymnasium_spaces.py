"""Convert an environment's spaces to Gymnasium's spaces."""

import gymnasium
import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.spaces import Space


def box(space: Space) -> gymnasium.spaces.Box:
    """Make a Box for one world's vector. The bounds are infinite if the space has none."""
    low, high = (-np.inf if space.low is None else space.low), (np.inf if space.high is None else space.high)
    return gymnasium.spaces.Box(low, high, shape=space.shape, dtype=np.float32)


def observation_space(env: Env, *, dict_obs: bool) -> gymnasium.Space:
    """Make the space of one world's observations: a Box for the group ``policy``, or a Dict of all groups."""
    if not dict_obs:
        return box(env.obs_space)
    return gymnasium.spaces.Dict({group: box(space) for group, space in env.obs_spaces.items()})
