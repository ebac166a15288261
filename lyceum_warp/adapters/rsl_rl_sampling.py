"""Sampling for rsl_rl's PPO in which a step has the policy's launches alone."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict

from lyceum_warp.algos.rollout_buffer import Rollout


class BatchedSampling:
    """Fills rsl_rl's storage with what ``act`` and ``process_env_step`` of PPO store in each step.

    A step stores what an environment gives, and the mean action. Values, densities and what stands for the rest of
    episodes that were cut off need nothing else: they are computed once for all steps, up to rounding the same. On a
    GPU a step of PPO has about a hundred launches without it, and twenty with it.

    Args:
        ppo: rsl_rl's PPO with an ``MLPModel`` for each network. Its storage holds the rollout's tensors from now on.
        rollout: The rollout, with the critic's groups.
        final: Whether the value of an episode's final observation stands for the rest of one that was cut off, rather
            than that of the observation before its last step.
    """

    def __init__(self, ppo: Any, rollout: Rollout, *, final: bool) -> None:
        self.ppo, self.rollout, self.final = ppo, rollout, final
        storage, shape = ppo.storage, rollout.action.shape
        storage.observations = TensorDict(dict(rollout.obs_groups), batch_size=shape[:2])
        storage.actions = rollout.action
        storage.distribution_params = (torch.zeros_like(rollout.action), torch.zeros_like(rollout.action))

    def sample(self, after_step: Callable[[], None]) -> None:
        """Step the environment under the policy.

        Args:
            after_step: Called after each step.
        """
        actor, rollout = self.ppo.actor, self.rollout
        env, policy = rollout.env, actor.distribution
        means, stds = self.ppo.storage.distribution_params
        for t in range(rollout.steps):
            policy.update(actor.mlp(actor.get_latent(env.obs_groups)))
            env.action.copy_(policy.sample())
            means[t].copy_(policy.mean)
            rollout.store_inputs()
            env.step()
            rollout.store_outputs()
            after_step()
        stds.copy_(policy.std[0].expand_as(stds))

    def value(self) -> None:
        """Compute values, densities, rewards with the rest of episodes that were cut off, returns and advantages."""
        ppo, rollout, storage = self.ppo, self.rollout, self.ppo.storage
        policy = ppo.actor.distribution
        policy.update(storage.distribution_params[0])
        storage.actions_log_prob.copy_(policy.log_prob(storage.actions).unsqueeze(-1))
        storage.values.copy_(self._values(rollout.obs_groups))
        rest = self._values(rollout.final_obs_groups) if self.final else storage.values
        cut = rollout.done & ~rollout.terminated
        rest = torch.where(cut.unsqueeze(-1), rest, 0.0)
        storage.rewards.copy_(rollout.reward.unsqueeze(-1) + ppo.gamma * rest)
        storage.dones.copy_(rollout.done.unsqueeze(-1))
        ppo.compute_returns(TensorDict(rollout.env.obs_groups, batch_size=[rollout.env.nworld]))

    def _values(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Values of observations, (steps, nworld, 1)."""
        critic = self.ppo.critic
        return critic.mlp(critic.get_latent(groups))
