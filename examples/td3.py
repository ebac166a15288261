"""Define an off-policy learner with lw.Replay: twin delayed DDPG (TD3; Fujimoto et al. 2018).

    python examples/td3.py
    python examples/td3.py --task half_cheetah --nworld 8 --iterations 200

``lw.train`` stores the replay buffer in the run's folder, so a resumed run equals an uninterrupted one bit for bit.
"""

import copy
import dataclasses
from pathlib import Path

import torch
import tyro

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class TD3Config:
    """Hyperparameters. Noise is in units of scaled actions, which lie between -1 and 1."""

    hidden: tuple[int, ...] = (64, 64)
    num_steps: int = 125
    """Steps of each world per iteration."""
    warmup: int = 1000
    """Number of random actions before learning starts."""
    batch: int = 256
    n_step: int = 1
    gamma: float = 0.99
    tau: float = 0.005
    """Weight of the learned networks in the moving average of the target networks."""
    learning_rate: float = 1e-3
    noise: float = 0.2
    """Standard deviation of the exploration noise."""
    target_noise: float = 0.2
    noise_limit: float = 0.5
    actor_every: int = 2
    """Updates of the critics per update of the actor."""


class TD3(lw.Learner):
    """Learns a deterministic policy. The targets use the smaller value of two critics."""

    algorithm = "td3"

    def __init__(self, env: lw.Env, config: TD3Config | None = None, *, seed: int = 0) -> None:
        super().__init__(env, seed=seed)
        self.config = config = config or TD3Config()
        space, device = env.action_space, env.obs.device
        init = torch.Generator().manual_seed(seed)
        self.policy = lw.SquashedPolicy(
            env.obs_space.size, space.size, config.hidden, low=space.low, high=space.high, generator=init
        ).to(device)
        self.value = lw.TwinCritic(env.obs_space.size, space.size, config.hidden, generator=init).to(device)
        self.targets = copy.deepcopy(torch.nn.ModuleList([self.policy, self.value]))
        self.optimizers = [torch.optim.Adam(m.parameters(), config.learning_rate) for m in (self.policy, self.value)]
        self.replay = lw.Replay(env)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.updates = 0

    def __next__(self) -> lw.Iteration:
        config, env, total, episodes = self.config, self.env, 0.0, 0
        losses = []
        for _ in range(config.num_steps):
            unit = self.policy.unit(self.policy.act(env.obs)) + config.noise * self.normal(env.action)
            if len(self.replay) < config.warmup:
                unit = torch.empty_like(env.action).uniform_(-1.0, 1.0, generator=self.generator)
            self.replay.step(self.policy.scaled(unit.clamp(-1.0, 1.0)))
            total += env.reward.sum()
            episodes += env.done.sum()
            if len(self.replay) >= config.warmup:
                losses += [self.update() for _ in range(env.nworld)]
        self.iteration += 1
        self.samples += config.num_steps * env.nworld
        return lw.Iteration(
            iteration=self.iteration, samples=self.samples, reward_mean=float(total) / (config.num_steps * env.nworld),
            numbers={"episodes": int(episodes), "critic_loss": float(torch.stack(losses).mean()) if losses else 0.0},
        )  # fmt: skip

    def update(self) -> torch.Tensor:
        """Update the critics, and in every second call the actor and the target networks. Return the critics' loss."""
        config, (actor, critic), (actor_step, critic_step) = self.config, self.targets, self.optimizers
        batch = self.replay.sample(config.batch, n_step=config.n_step, gamma=config.gamma, generator=self.generator)
        obs, next_obs = batch.obs["policy"], batch.next_obs["policy"]
        with torch.no_grad():
            noise = config.target_noise * self.normal(batch.action)
            unit = actor.unit(actor.act(next_obs)) + noise.clamp(-config.noise_limit, config.noise_limit)
            # discount contains gamma, and is 0 after a termination
            target = batch.reward + batch.discount * critic(next_obs, unit.clamp(-1.0, 1.0)).amin(0)
        loss = (self.value(obs, self.policy.unit(batch.action)) - target).square().mean(1).sum()
        descend(critic_step, loss)
        self.updates += 1
        if self.updates % config.actor_every == 0:
            descend(actor_step, -self.value(obs, self.policy.unit(self.policy.act(obs)))[0].mean())
            with torch.no_grad():
                parameters = [*self.policy.parameters(), *self.value.parameters()]
                for target, parameter in zip(self.targets.parameters(), parameters, strict=True):
                    target.lerp_(parameter, config.tau)
        return loss.detach()

    def normal(self, like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=self.generator, device=like.device)

    def state_dict(self) -> dict:
        entries = {
            "targets": self.targets.state_dict(), "updates": self.updates,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }  # fmt: skip
        return super().state_dict() | copy.deepcopy(entries)

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.targets.load_state_dict(state["targets"])
        self.updates = state["updates"]
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)


def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def main(
    task: str = "inverted_pendulum", nworld: int = 4, iterations: int = 8, seed: int = 0,
    out: Path = Path("runs/td3"), resume: bool = False,
) -> None:  # fmt: skip
    """Train, or continue a run with --resume, and evaluate the policy."""
    learner = TD3(lw.make(task, nworld=nworld, seed=seed), seed=seed)
    run = lw.train(
        learner, lw.Run.open(out) if resume else out, iterations,
        callbacks=[lambda it: print(f"iteration {it.iteration}: {it.numbers['episodes']} episodes ended")],
    )  # fmt: skip
    few = lw.make(task, nworld=8, horizon=1000)
    print(f"return {lw.evaluate(few, lw.load(run), 8, seed=1).returns.mean():.1f}, in {run.folder}")


if __name__ == "__main__":
    tyro.cli(main)
