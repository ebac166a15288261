"""Train an actor and a critic in plain torch, on the environment's own buffers.

    python examples/torch_loop.py
    python examples/torch_loop.py --device cuda --nworld 4096

The environment updates its tensors in place. Clone a tensor to keep its values.
"""

import torch
import tyro
from torch import nn

import lyceum_warp as lw


def main(nworld: int = 256, iterations: int = 100, steps: int = 32, device: str = "cpu", seed: int = 0) -> None:
    """Learn to push a point onto a target (advantage actor-critic)."""
    torch.manual_seed(seed)
    env = lw.make("point_mass", nworld=nworld, device=device, seed=seed, horizon=128)
    nobs, nact, gamma = env.obs_space.size, env.action_space.size, 0.95
    actor = nn.Sequential(nn.Linear(nobs, 64), nn.Tanh(), nn.Linear(64, nact)).to(device)
    critic = nn.Sequential(nn.Linear(nobs, 64), nn.Tanh(), nn.Linear(64, 1), nn.Flatten(0)).to(device)
    log_std = nn.Parameter(torch.full((nact,), -1.0, device=device))
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], lr=1e-2)

    for iteration in range(1, iterations + 1):
        samples = []
        for _ in range(steps):
            obs = env.obs.clone()  # env.obs changes in place
            with torch.no_grad():
                action = torch.normal(actor(obs), log_std.exp())
            env.step(action)  # the step restarts worlds whose episode ended
            with torch.no_grad():
                # env.obs may already belong to a new episode, so bootstrap from env.final_obs, the observation after
                # this step. After a termination, do not bootstrap.
                next_value = critic(env.final_obs) * ~env.terminated
            outcome = env.reward.clone(), env.done.clone(), env.eval.clone()
            samples.append((obs, action, next_value, *outcome))

        obs, action, next_value, reward, done, distance = map(torch.stack, zip(*samples, strict=True))
        target = reward + gamma * next_value
        for t in reversed(range(steps - 1)):  # sum up rewards backwards until an episode ends
            target[t] = torch.where(done[t], target[t], reward[t] + gamma * target[t + 1])
        value = critic(obs.flatten(0, 1))
        advantage = target.flatten() - value.detach()
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        log_prob = torch.distributions.Normal(actor(obs), log_std.exp()).log_prob(action).sum(-1).flatten()
        loss = (value - target.flatten()).square().mean() - (log_prob * advantage).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if done.any():  # env.eval is the distance to the target
            print(f"iteration {iteration:3d}: {done.sum()} episodes ended {distance[done].mean():.3f} m off the target")


if __name__ == "__main__":
    tyro.cli(main)
