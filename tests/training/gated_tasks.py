"""Point masses with gates, which limit the mean distance to the target after 50 steps, and one with coarse physics."""

from collections.abc import Callable, Iterator

import torch

import lyceum_warp as lw
from lyceum_warp.tasks.point_mass import *  # noqa: F403
from lyceum_warp.tasks.point_mass import PointMass


class Near(lw.Gate):
    def __init__(self, high: float) -> None:
        self.limits = {
            "distance": lw.Limit("mean distance, m", high=high),
            "largest": lw.Limit("largest distance, m"),
        }

    def measure(
        self, worlds: Callable[..., lw.Env], act: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[dict[str, float]]:
        env = worlds(20)
        for _ in range(50):
            env.step(act(env.obs))
        yield {"distance": env.eval.mean().item()}
        yield {"largest": env.eval.max().item()}


class Easy(PointMass):
    gate = Near(10.0)


class Impossible(PointMass):
    gate = Near(0.0)


class Coarse(PointMass):
    physics = {"coarse": lw.PhysicsOptions(integrator="discrete", cone="elliptic")}
    training = lw.Training(
        algorithm="ppo", settings={"num_steps": 8, "hidden": (4,), "value_hidden": (4,)}, physics="coarse", exact_from=2
    )
