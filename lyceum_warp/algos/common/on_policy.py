"""Define the base class of NPG and PPO, with their networks, rollouts, advantages, evaluation and checkpoints."""

import dataclasses
from typing import Any, ClassVar

import torch
import warp as wp

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.hyperparameters import PictureConfig
from lyceum_warp.algos.common.networks import LIMIT, initialize_as_torch, trainable
from lyceum_warp.algos.common.pictures import policy_inputs, policy_settings
from lyceum_warp.algos.common.policy import GaussianPolicy
from lyceum_warp.algos.common.policy_check import check_policy, check_value
from lyceum_warp.algos.common.rollout_buffer import Rollout
from lyceum_warp.algos.common.sampling import SamplingLearner
from lyceum_warp.algos.common.value import ValueFunction, value_group
from lyceum_warp.env.env import Env
from lyceum_warp.kernels import returns


class OnPolicyLearner(SamplingLearner):
    """Base class of NPG and PPO, which learn a Gaussian policy and a value function from a rollout."""

    twice: ClassVar[bool]
    """Whether the policy must be twice differentiable."""
    policy: GaussianPolicy
    value: ValueFunction

    def __init__(
        self,
        env: Env,
        policy: GaussianPolicy | None,
        value: ValueFunction | None,
        config: Any,
        *,
        seed: int,
        team: Team | None,
    ) -> None:
        super().__init__(env, config, seed=seed, team=team)
        if value is not None:
            check_value(trainable(value), env, memory=not self.twice)
        if policy is not None:
            check_policy(trainable(policy), env, twice=self.twice)

    def _make_networks(
        self,
        policy: GaussianPolicy | None,
        value: ValueFunction | None,
        *,
        scale: float,
        time_orders: int = 0,
        limit: float = LIMIT,
        as_torch: bool = False,
    ) -> None:
        env, config, device = self.env, self.config, self.env.obs.device
        nobs, nact, sees = env.obs_space.size, env.action_space.size, dict[str, Any]()
        if isinstance(config, PictureConfig):
            nobs, sees = policy_inputs(env, config)
        group = value_group(env, config.value_group) if value is None else value.group
        init = torch.Generator().manual_seed(self.seed)
        options: dict[str, Any] = dict(normalize=config.normalize, limit=limit, generator=init)
        self.policy = policy or GaussianPolicy(
            nobs, nact, config.hidden, activation=config.activation, log_std=config.log_std,
            recurrent=getattr(config, "recurrent", 0), **sees, **options,
        )  # fmt: skip
        recurrent = self.policy.state_size if group == "policy" and not self.policy.pictures else 0
        self.value = value or ValueFunction(
            env.obs_spaces[group].size, config.value_hidden, activation=config.value_activation, scale=scale,
            time_orders=time_orders, group=group, recurrent=recurrent, **options,
        )  # fmt: skip
        if as_torch and policy is None:
            initialize_as_torch(getattr(self.policy.network, "network", self.policy), init)  # not the encoders
        if as_torch and value is None:
            initialize_as_torch(self.value, init)
        self.value.discount = config.gamma
        self.policy.to(device)
        self.value.to(device)
        self.generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=init)))

    def _make_rollout(self, steps: int, *, first_only: bool = False) -> None:
        self.count = steps * self.env.nworld * self.team.size
        groups = dict.fromkeys((self.value.group, *self.policy.groups))
        self.rollout = Rollout(self.env, steps, groups=list(groups), first_only=first_only)
        self._advantage = torch.empty_like(self.rollout.reward)
        self._return = torch.empty_like(self.rollout.reward)

    def _estimate(
        self, reward: torch.Tensor, value: torch.Tensor, next_value: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        arrays = (reward, value, next_value, self.rollout.terminated, self.rollout.done)
        outputs = [wp.from_torch(self._advantage), wp.from_torch(self._return)]
        args = [*map(wp.from_torch, arrays), self.config.gamma, self.config.lam, *outputs]
        wp.launch(returns.advantages, self.env.nworld, args, device=self.env.device)
        return self._advantage, self._return

    def settings(self) -> dict[str, Any]:
        """Return the hyperparameters and the networks' sizes for a run's config.json."""
        value = self.value.shape
        settings = policy_settings(self.policy) | {f"value_{name}": value[name] for name in ("hidden", "activation")}
        settings["time_orders"] = value["time_orders"]
        if self.config.value_group is not None or value["group"] != value_group(self.env, None):
            settings["value_group"] = value["group"]
        fields = {name: settings[name] for name in settings if hasattr(self.config, name)}
        return dataclasses.asdict(dataclasses.replace(self.config, **fields))
