"""An environment's spaces as Gymnasium's."""

import numpy as np

from lyceum_warp.adapters.gymnasium_library import gymnasium
from lyceum_warp.env import Env
from lyceum_warp.spaces import Space


def box(space: Space) -> gymnasium.spaces.Box:
    """The vector of one world; infinite where it has no bounds."""
    low, high = (-np.inf if space.low is None else space.low), (np.inf if space.high is None else space.high)
    return gymnasium.spaces.Box(low, high, shape=space.shape, dtype=np.float32)


def observation_space(env: Env, *, dict_obs: bool) -> gymnasium.Space:
    """The observation of one world: that of the group ``policy``, or of every group by its name."""
    if not dict_obs:
        return box(env.obs_space)
    return gymnasium.spaces.Dict({group: box(space) for group, space in env.obs_spaces.items()})


def action_space(env: Env) -> gymnasium.spaces.Box:
    """The action of one world."""
    return box(env.action_space)
