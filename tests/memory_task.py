"""Define a task and a policy with memory that both count the steps of an episode."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
import warp as wp
from rail_task import rail
from torch import nn

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    steps: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.steps[0]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.steps[0] = s0.steps[0] + 1.0


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return action[0]


class Counts(lw.Gate):
    limits = {"error": lw.Limit("largest difference", high=0.0)}

    def measure(self, worlds: Callable[..., Any], act: Callable[[Any], Any]) -> Iterator[dict[str, float]]:
        for nworld in (3, 2):
            env = worlds(nworld)
            for step in range(6):
                env.step(act(env.obs))
                if step == 3:
                    env.rand_reset(mask=torch.arange(nworld) == 1)
            yield {"error": (env.action - env.obs + 1.0).abs().max().item()}


class Counting(lw.Task):
    """The observation is the number of steps since the episode began."""

    model, obs, horizon, gate = staticmethod(rail), {"steps": 1}, 5, Counts()


class Counter(nn.Module):
    """A policy with memory whose action is the number of its calls since the episode began, and equals ``obs``."""

    nobs, nact, state_size = 1, 1, 2

    def act(self, obs: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        assert ((state[..., :1] - obs).abs() < 0.5).all(), (state, obs)  # a check may change the observation by 0.1
        return state[..., :1], state + 1.0
