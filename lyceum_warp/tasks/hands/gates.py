"""Test whether a hand turns an object and holds it."""

from collections.abc import Callable, Iterator
from typing import Any

import torch

import lyceum_warp as lw

WORLDS, STEPS, PART = 64, 1000, 200


class Turns(lw.Gate):
    """64 worlds for 50 s, with noise. A world whose object falls starts again.

    Args:
        metric: Name of the metric that is summed over the 50 s.
        text: What the sum is, with its unit.
        least: Least mean of the sum over all worlds.
        drops: Most drops per hour.
        params: Parameters of the task.
    """

    def __init__(self, metric: str, text: str, *, least: float, drops: float, **params: Any) -> None:
        self.metric, self.params = metric, params
        self.limits = {
            "drops": lw.Limit("drops per hour", high=drops),
            "first": lw.Limit(f"{text} in the first 10 s", low=0.1 * least),
            metric: lw.Limit(f"{text} in 50 s", low=least),
        }

    def measure(
        self, worlds: Callable[..., lw.Env], act: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[dict[str, float]]:
        """Yield the numbers after 10 s and after 50 s."""
        env = worlds(WORLDS, **self.params)
        total, drops = turned(env, act, self.metric, PART)
        yield {"first": total.mean().item()}
        later = turned(env, act, self.metric, STEPS - PART)
        hours = STEPS * env.timestep / 3600.0
        yield {"drops": (drops + later[1]).mean().item() / hours, self.metric: (total + later[0]).mean().item()}


def turned(
    env: lw.Env, act: Callable[[torch.Tensor], torch.Tensor], metric: str, steps: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sum a metric over steps, and count the drops. Both results are (nworld,). A world starts again after a drop."""
    total, drops = torch.zeros(2, env.nworld, device=env.obs.device)
    for _ in range(steps):
        env.step(act(env.obs))
        total += env.metrics[metric]
        drops += env.done
        if env.done.any():
            env.rand_reset(mask=env.done.clone())
    return total, drops
