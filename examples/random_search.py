"""Define a learner for lw.train: augmented random search with a linear policy (Mania et al. 2018).

    python examples/random_search.py
    python examples/random_search.py --task hopper --nworld 64 --iterations 300 --video-every 100

The class has no code for files: ``lw.train`` writes a run folder with metrics, policies, checkpoints and videos.
"""

import dataclasses
from pathlib import Path

import torch
import tyro

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    step: float = 1.0
    """Learning rate of the weights. Returns are divided by their standard deviation."""
    noise: float = 0.5
    """Standard deviation of the perturbations of the weights."""


class RandomSearch(lw.Learner):
    """Perturbs the weights of a linear policy. Each pair of worlds tries one perturbation with both signs."""

    algorithm = "random-search"

    def __init__(self, env: lw.Env, config: SearchConfig | None = None, *, seed: int = 0) -> None:
        super().__init__(env, seed=seed)
        self.config = config or SearchConfig()
        self.policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, hidden=(), normalize=True)
        torch.nn.init.zeros_(self.policy.to(env.obs.device).network[0].weight)
        self.generator = torch.Generator(env.obs.device).manual_seed(seed)

    @torch.no_grad()
    def __next__(self) -> lw.Iteration:
        env, weight, normalizer = self.env, self.policy.network[0].weight, self.policy.normalizer
        shape = env.nworld // 2, *weight.shape
        change = torch.randn(shape, generator=self.generator, device=weight.device)
        tried = weight + self.config.noise * torch.cat([change, -change])
        env.rand_reset()
        returns, going = torch.zeros_like(env.reward), torch.ones_like(env.done)
        for _ in range(env.horizon):
            env.step(torch.einsum("wao,wo->wa", tried, normalizer(env.obs)))
            returns += env.reward * going  # count only the first episode of each world
            going &= ~env.done
        self.policy.observe(env.obs)
        plus, minus = returns.chunk(2)
        difference = (plus - minus) / (returns.std() + 1e-8)
        weight += self.config.step * torch.einsum("w,wao->ao", difference, change) / len(change)
        self.iteration += 1
        self.samples += env.nworld * env.horizon
        mean = lw.evaluate(env, self.policy, env.nworld).returns.mean().item()
        return lw.Iteration(
            iteration=self.iteration, samples=self.samples, return_mean=returns.mean().item(), mean_return=mean,
            numbers={"weight_norm": weight.norm().item()},
        )  # fmt: skip


def main(
    task: str = "inverted_pendulum", nworld: int = 32, horizon: int = 200, iterations: int = 10, seed: int = 0,
    out: Path = Path("runs/random-search"), resume: bool = False, video_every: int = 0,
) -> None:  # fmt: skip
    """Train, or continue a run with --resume."""
    learner = RandomSearch(lw.make(task, nworld=nworld, horizon=horizon, seed=seed), seed=seed)
    callbacks = [lambda it: print(f"iteration {it.iteration}: return {it.mean_return:.1f}")]
    if video_every:
        callbacks.append(lw.Videos(video_every))
    run = lw.train(learner, lw.Run.open(out) if resume else out, iterations, callbacks=callbacks)
    print(f"best policy: return {run.best_score()[1]:.1f} in {run.folder}")


if __name__ == "__main__":
    tyro.cli(main)
