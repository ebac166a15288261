"""Fill NPG's rollout buffer from Gymnasium's vector environments."""

import contextlib
import functools
import time

import gymnasium
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

import lyceum_warp as lw
from lyceum_warp.algos import GaussianPolicy, Rollout
from lyceum_warp.algos.common.dense import DensePolicy

TASKS = {"swimmer": "Swimmer-v5", "hopper": "Hopper-v5", "walker2d": "Walker2d-v5"}


class GymnasiumRollout(Rollout):
    """Fill NPG's rollout buffer from a Gymnasium vector environment.

    Each world's first episode starts with the step count that this world has in ``env``.
    """

    def __init__(self, env: lw.Env, steps: int, envs: VectorEnv, seed: int, *, segments: bool) -> None:
        super().__init__(env, steps, first_only=not segments)
        self.envs = envs
        self.now, _ = envs.reset(seed=1000 * seed)
        self.elapsed = torch.zeros(env.nworld)
        if segments:
            self.elapsed.copy_(env.episode_step)
            # the outermost wrapper, TimeLimit, has this attribute
            envs.set_attr("_elapsed_steps", env.episode_step.tolist())
            self.running_return.masked_fill_(self.elapsed > 0, torch.nan)

    def restart(self) -> None:
        self.now, _ = self.envs.reset()
        self.elapsed.zero_()
        self.running_return.zero_()

    @torch.no_grad()
    def collect(self, policy: GaussianPolicy | DensePolicy, noise: torch.Tensor) -> None:
        for t in range(self.steps):
            self.obs[t].copy_(torch.from_numpy(self.now))
            self.step[t] = self.elapsed
            policy.sample(self.obs[t], noise[t], out=self.action[t])
            self.now, reward, terminated, truncated, info = self.envs.step(self.action[t].numpy())
            done = terminated | truncated
            self.final_obs[t].copy_(torch.from_numpy(self.now))
            for world in done.nonzero()[0]:
                self.final_obs[t, world].copy_(torch.from_numpy(info["final_obs"][world]))
            self.reward[t].copy_(torch.from_numpy(reward))
            self.terminated[t].copy_(torch.from_numpy(terminated))
            self.done[t].copy_(torch.from_numpy(done))
            self.elapsed += 1.0
            self.running_return += self.reward[t]
            self.episode_return[t] = self.running_return
            self.episode_length[t] = self.elapsed
            self.running_return.masked_fill_(self.done[t], torch.nan if self._first_only else 0.0)
            self.elapsed.masked_fill_(self.done[t], 0.0)


def vector(task: str, nworld: int, mode: str) -> VectorEnv:
    made = [functools.partial(gymnasium.make, TASKS[task], disable_env_checker=True)] * nworld
    if mode == "sync":
        return SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP)
    # fork is Gymnasium's default on Linux; with spawn, each world would import this whole program
    return AsyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP, context="fork")


def rates(task: str, nworld: int, steps: int) -> dict[str, float]:
    found = {}
    for mode in ("sync", "async"):
        with contextlib.closing(vector(task, nworld, mode)) as envs:
            envs.reset(seed=0)
            envs.action_space.seed(0)
            actions = [envs.action_space.sample() for _ in range(steps)]
            envs.step(actions[0])
            start = time.perf_counter()
            for action in actions:
                envs.step(action)
            found[mode] = steps * nworld / (time.perf_counter() - start)
    return found
