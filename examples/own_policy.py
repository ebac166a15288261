"""Train a custom network by NPG: linear feedback plus a nonlinear correction, limited to the action range.

    python examples/own_policy.py
    python examples/own_policy.py --task half_cheetah --iterations 100

The network is any torch module that maps observations (..., nobs) to mean actions (..., nact). ``lw.GaussianPolicy``
normalises observations, adds noise to the mean actions and computes log-probabilities.
"""

import torch
import tyro
from torch import nn

import lyceum_warp as lw


class Feedback(nn.Module):
    def __init__(self, nobs: int, low: torch.Tensor, high: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("middle", 0.5 * (high + low))
        self.register_buffer("extent", 0.5 * (high - low))
        nact = len(self.middle)
        self.gains = nn.Linear(nobs, nact)
        self.correction = nn.Sequential(nn.Linear(nobs, 32), nn.LayerNorm(32), nn.ELU(), nn.Linear(32, nact))
        for last in (self.gains, self.correction[-1]):
            nn.init.normal_(last.weight, std=0.01)  # the first actions are near the middle of their range

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.middle + self.extent * torch.tanh(self.gains(obs) + self.correction(obs))


def main(
    task: str = "point_mass", nworld: int = 40, samples: int = 10_240, iterations: int = 15, seed: int = 0
) -> None:
    """Train the policy and evaluate it."""
    torch.manual_seed(seed)
    env = lw.make(task, nworld=nworld, seed=seed)
    nobs, nact = env.obs_space.size, env.action_space.size
    low, high = torch.tensor(env.action_space.low), torch.tensor(env.action_space.high)
    policy = lw.GaussianPolicy(nobs, nact, network=Feedback(nobs, low, high))

    for it in lw.NPG(env, policy, config=lw.NPGConfig(samples=samples), seed=seed):
        print(f"iteration {it.iteration:3d}  return {it.return_mean:7.1f}  KL {it.kl:.3f}")
        if it.iteration == iterations:
            break

    episodes = lw.evaluate(env, policy, 20, seed=seed + 1)
    print(
        f"mean policy: return {episodes.returns.mean():.1f}, {sum(p.numel() for p in policy.parameters())} parameters"
    )


if __name__ == "__main__":
    tyro.cli(main)
