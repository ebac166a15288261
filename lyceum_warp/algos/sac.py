"""Learn policies by soft actor-critic (SAC).

SAC was proposed by Haarnoja et al., 2018 ("Soft Actor-Critic Algorithms and Applications"). It has twin critics, slowly
moving target critics, and a temperature that is adapted to reach a target entropy.

With many worlds and large batches, this implementation is close to FastSAC (Seo et al. 2025, "Learning Sim-to-Real
Humanoid Locomotion in 15 Minutes"). If the critics predict quantiles, the targets drop the largest quantiles, as in TQC
(Kuznetsov et al. 2020, "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics").
"""

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from torch.optim.swa_utils import get_ema_multi_avg_fn

from lyceum_warp.algos.common.adam import GradientStep
from lyceum_warp.algos.common.distributed import Captured, Team
from lyceum_warp.algos.common.hyperparameters import GROUP, LEAST, Activation
from lyceum_warp.algos.common.minibatches import precision, room
from lyceum_warp.algos.common.networks import trainable
from lyceum_warp.algos.common.policy_check import check_sizes
from lyceum_warp.algos.common.replay import Replay, Transitions, default_capacity
from lyceum_warp.algos.common.rollout_buffer import Rollout
from lyceum_warp.algos.common.rollout_statistics import SampledIteration, gathered
from lyceum_warp.algos.common.sampling import SamplingLearner
from lyceum_warp.algos.common.squashed_policy import SquashedPolicy
from lyceum_warp.algos.common.symmetry import apply_symmetry
from lyceum_warp.algos.common.timing import PhaseTimer
from lyceum_warp.algos.common.twin_critic import TwinCritic, quantile_loss
from lyceum_warp.algos.common.value import value_group
from lyceum_warp.env.env import Env
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, check_kind

_EPS = 1e-2
"""Constant that is added to the normalisers' standard deviations."""


_RULES: dict[str, Rule] = {
    "num_steps": 1, "replay": 1, "warmup": 0, "updates": 1, "actor_every": 1, "batch": 1, "n_step": 1, "quantiles": 1,
    "dropped_quantiles": 0, "mean_every": 0, "mean_episodes": 1, "gamma": (0.0, 1.0), "tau": (0.0, 1.0),
    "learning_rate": 0.0, "temperature": 1e-6, "target_entropy": LEAST, "action_limit": 1e-6, "symmetry_coef": 0.0,
    "value_group": GROUP,
}  # fmt: skip

MANY_WORLDS = 256

_FEW: dict[str, Any] = {
    "batch": 256, "actor_every": 1, "gamma": 0.99, "tau": 0.005, "temperature": 1.0, "target_entropy": -1.0,
    "critic_bound": "min", "hidden": (256, 256), "value_hidden": (256, 256),
}  # fmt: skip
"""Defaults for fewer than 256 worlds, from Haarnoja et al., 2018."""

_MANY: dict[str, Any] = {
    "batch": 8192, "actor_every": 4, "gamma": 0.97, "tau": 0.125, "temperature": 1e-3, "target_entropy": 0.0,
    "critic_bound": "mean", "hidden": (512, 256, 128), "value_hidden": (512, 512, 512),
}  # fmt: skip
"""Defaults for 256 worlds or more, close to the settings of Seo et al., 2025, for humanoids."""


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class SACConfig:
    """Hyperparameters of SAC.

    If a hyperparameter is None, its default depends on the number of worlds. Defaults for fewer than 256 worlds follow
    Haarnoja et al., 2018 ("Soft Actor-Critic Algorithms and Applications"). Defaults for 256 worlds or more are close
    to Seo et al., 2025 ("Learning Sim-to-Real Humanoid Locomotion in 15 Minutes").

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite, or ``dropped_quantiles`` leaves no
            quantile.
    """

    num_steps: int | None = None
    """Number of steps of every world per iteration. The default is 50, or more if 50 steps make fewer than 1,000
    samples."""
    replay: int | None = None
    """Capacity of the replay buffer in samples. The default is 1,024 steps of every world, but at least a million
    samples. The default buffer takes at most 30 % of the device's free memory."""
    warmup: int | None = None
    """Number of samples with random actions before the first update. The default is 10 steps of every world, but at
    least 5,000 samples."""
    updates: int | None = None
    """Number of updates of the critics after each step of all worlds. The default is the number of worlds, but at most
    8."""
    actor_every: int | None = None
    """Number of updates of the critics for each update of the actor; must divide ``updates``. The default is 4
    with 256 or more worlds, and otherwise 1."""
    batch: int | None = None
    """Number of samples in an update. The default is 8,192 samples with 256 or more worlds, and otherwise 256."""
    n_step: int = 1
    """Maximum number of rewards in a target of the critics (n-step returns)."""
    gamma: float | None = None
    """Discount factor. The default is 0.97 with 256 or more worlds, and otherwise 0.99."""
    tau: float | None = None
    """Fraction by which each update moves the target critics towards the critics (Polyak averaging). The default is
    0.125 with 256 or more worlds, and otherwise 0.005."""
    quantiles: int = 1
    """Number of quantiles that each critic predicts; with 1, it predicts the mean. TQC (Kuznetsov et al., 2020) uses
    25."""
    dropped_quantiles: int = 2
    """Number of dropped quantiles per critic, as in TQC. For each target, SAC pools the quantiles of both critics, and
    drops the largest. With one quantile, the targets use ``critic_bound`` instead."""
    critic_bound: Literal["min", "mean"] | None = None
    """Value of an action if ``quantiles`` is 1: the minimum or the mean of the two critics' predictions. The default is
    "mean" with 256 or more worlds, and otherwise "min"."""
    learning_rate: float = 3e-4
    """Learning rate of the actor, the critics and the temperature (Adam)."""
    temperature: float | None = None
    """Initial temperature, the learned weight of the entropy. The default is 0.001 with 256 or more worlds, and
    otherwise 1."""
    target_entropy: float | None = None
    """Target entropy of the policy for each element of an action, where actions are scaled to [-1, 1]. SAC adapts the
    temperature to reach it. The default is 0 with 256 or more worlds, and otherwise -1."""
    action_limit: float = 1.0
    """Largest absolute value of actions that the task does not bound."""
    hidden: tuple[int, ...] | None = None
    """Widths of the policy's hidden layers. With 256 or more worlds, the default is (512, 256, 128). With fewer worlds,
    it is (256, 256)."""
    activation: Activation = "relu"
    """Activation of the policy's hidden layers."""
    value_hidden: tuple[int, ...] | None = None
    """Widths of the critics' hidden layers. With 256 or more worlds, the default is (512, 512, 512). With fewer worlds,
    it is (256, 256)."""
    value_activation: Activation = "relu"
    """Activation of the critics' hidden layers."""
    value_group: str | None = None
    """Group of observations for the critics; by default "critic" if the task has this group, else "policy"."""
    layer_norm: bool = True
    """Whether to apply layer normalisation to the critics' hidden layers."""
    symmetry: Literal["none", "exact", "loss", "augment"] = "none"
    """How to use the mirror symmetry that a task declares (``lw.Mirror``). "exact" averages the policy with its mirror
    image. "loss" adds a term to the loss: symmetry_coef times the squared difference between the policy and its mirror
    image. "augment" also learns from the mirror images of all samples. "none" ignores the symmetry."""
    symmetry_coef: float = 1.0
    """Coefficient of the symmetry loss, if symmetry is "loss"."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance, updated in every step."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    bf16: bool = False
    """Whether SAC computes the losses in bfloat16 (torch.autocast)."""
    compiled: bool = False
    """Whether torch.compile compiles the losses. Compilation takes about half a minute."""
    mean_every: int = 10
    """Iterations between evaluations of the mean policy; 0 means no evaluations."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        """Check every value."""
        check_fields(self, _RULES)
        if self.dropped_quantiles >= self.quantiles > 1:
            raise ValueError(
                f"dropped_quantiles={self.dropped_quantiles} must be less than quantiles, which is {self.quantiles}"
            )

    def resolved(self, nworld: int) -> "SACConfig":
        """Replace None by defaults in all fields except ``replay`` and ``value_group``.

        Args:
            nworld: Number of worlds of all processes.

        Raises:
            ValueError: ``actor_every`` does not divide ``updates``.
        """
        updates = min(nworld, 8)
        rules = {"num_steps": max(50, -(-1_000 // nworld)), "warmup": max(5_000, 10 * nworld), "updates": updates}
        defaults = rules | (_FEW if nworld < MANY_WORLDS else _MANY)
        config = dataclasses.replace(self, **{k: v for k, v in defaults.items() if getattr(self, k) is None})
        assert config.updates is not None and config.actor_every is not None
        if config.updates % config.actor_every:
            raise ValueError(
                f"updates={config.updates} must be a multiple of actor_every, which is {config.actor_every}"
            )
        return config


@dataclasses.dataclass(frozen=True, kw_only=True)
class SACIteration(SampledIteration):
    """Statistics of one iteration of SAC.

    Losses, values and entropy are means over the iteration's updates, or NaN without an update.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended. They exclude
    each world's first episode, which starts at a random step.
    """

    critic_loss: float
    """Sum of the two critics' losses: quantile Huber losses, or mean squared errors if ``quantiles`` is 1."""
    q_mean: float
    """Mean of the critics' predictions."""
    actor_loss: float
    """Loss of the actor."""
    entropy: float
    """Entropy of the policy for actions scaled to [-1, 1]."""
    temperature: float
    """Temperature (the weight of the entropy) after the iteration."""
    time_update: float
    """Seconds for the updates."""


class SAC(SamplingLearner):
    """Infinite iterator of ``SACIteration`` that learns a policy by SAC.

    In an iteration, every world makes ``num_steps`` steps, and each step is followed by ``updates`` updates. On a GPU,
    the updates after a step run as one CUDA graph, including the sampling of their batches.

    Example:
        >>> for it in SAC(env):
        ...     print(it.return_mean)

    Args:
        env: The environment, which must not be stepped between iterations.
        policy: The policy; by default a new policy. If you pass a policy, it also acts during the warm-up.
        value: The critics; by default new critics.
        config: Hyperparameters.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together. Each has some of the worlds, and a replay buffer for them. All
            processes must make the same calls with the same arguments; all get the same statistics.

    Raises:
        ValueError: The environment does not reset automatically, or an argument does not fit the environment.
        FloatingPointError: A loss, or a parameter of a network, is not finite after an iteration.
    """

    algorithm = "sac"
    """The name of the algorithm in a run's config.json."""
    config_type = SACConfig
    policy: SquashedPolicy
    value: TwinCritic
    """The critics."""
    target: TwinCritic
    """The target critics, which share the critics' normaliser."""
    config: Any
    """Hyperparameters: an ``SACConfig`` with defaults in place of None."""
    replay: Replay
    """The samples of this process's worlds."""
    log_temperature: torch.Tensor
    """Logarithm of the temperature."""

    def __init__(
        self,
        env: Env,
        policy: SquashedPolicy | None = None,
        value: TwinCritic | None = None,
        config: SACConfig | None = None,
        *,
        seed: int = 0,
        team: Team | None = None,
    ) -> None:
        check_kind("policy of SAC", policy, SquashedPolicy | None, "as lw.load(run) returns it for a run of SAC")
        check_kind("value of SAC", value, TwinCritic | None, "as lw.load_value(run) returns it for a run of SAC")
        super().__init__(env, config, seed=seed, team=team)
        self._all_worlds, self._warms_up = env.nworld * self.team.size, policy is None
        self.config = self.config.resolved(self._all_worlds)
        init = torch.Generator().manual_seed(self.seed)
        self._make_networks(policy, value, init)
        self._make_replay()
        self.generator = torch.Generator(env.obs.device).manual_seed(int(torch.randint(2**62, (), generator=init)))
        self._make_buffers()
        self.rollout.restart()
        self.rollout.stagger(self.generator, self.team)

    def _make_networks(
        self, policy: SquashedPolicy | None, value: TwinCritic | None, generator: torch.Generator
    ) -> None:
        """Make the networks that are not given, the target critics and the optimisers."""
        env, config, device = self.env, self.config, self.env.obs.device
        nact = env.action_space.size
        options: dict[str, Any] = dict(normalize=config.normalize, generator=generator)
        low, high = action_bounds(env, config.action_limit)
        group = value_group(env, config.value_group) if value is None else value.group
        self.policy = policy or SquashedPolicy(
            env.obs_space.size, nact, config.hidden, low=low, high=high, activation=config.activation, **options
        )
        self.value = value or TwinCritic(
            env.obs_spaces[group].size, nact, config.value_hidden, activation=config.value_activation,
            layer_norm=config.layer_norm, quantiles=config.quantiles, group=group, **options,
        )  # fmt: skip
        check_sizes(self.policy, env)
        check_sizes(self.value, env, "the value function", group=value_group(env, group))
        if (bounds := (self.policy.shape["low"], self.policy.shape["high"])) != (low, high):
            raise ValueError(
                f"the policy's actions are from {bounds[0]} to {bounds[1]}, but actions of the task {env.task.name!r} "
                f"are from {low} to {high}"
            )
        trainable(self.policy.to(device))
        trainable(self.value.to(device))
        self._mirror, self._mirror_value = apply_symmetry(config.symmetry, env, self.policy, self.value.group)
        self.target = copy.deepcopy(self.value).requires_grad_(False)
        self.target.normalizer = self.value.normalizer
        self._follow = get_ema_multi_avg_fn(1.0 - config.tau)
        self.log_temperature = torch.tensor(math.log(config.temperature), device=device, requires_grad=True)
        self.actor_step = GradientStep(self.policy.parameters(), config.learning_rate, self.team)
        self.critic_step = GradientStep(self.value.parameters(), config.learning_rate, self.team)
        self.temperature_step = GradientStep([self.log_temperature], config.learning_rate, self.team)
        self._steps = self.actor_step, self.critic_step, self.temperature_step
        actor, critics = self.policy.shape, self.value.shape
        self.config = dataclasses.replace(
            config, hidden=tuple(actor["hidden"]), activation=actor["activation"], normalize=actor["normalize"],
            value_hidden=tuple(critics["hidden"]), value_activation=critics["activation"],
            layer_norm=critics["layer_norm"], quantiles=critics["quantiles"],
            symmetry="exact" if self.policy.mirror is not None else config.symmetry,
        )  # fmt: skip

    def _make_replay(self) -> None:
        env, config, team = self.env, self.config, self.team
        (least,) = team.largest(-default_capacity(env, team.size))
        capacity = -least * team.size if config.replay is None else config.replay
        self.config = dataclasses.replace(config, replay=capacity)
        self.replay = Replay(env, -(-capacity // team.size))
        self.rollout = Rollout(env, config.num_steps)
        self.count = config.num_steps * self._all_worlds

    def _make_buffers(self) -> None:
        """Allocate the inputs of the updates, and prepare the losses."""
        config, team, device = self.config, self.team, self.env.obs.device
        share = room(config.batch, team)
        self._act_noise = torch.empty(self._all_worlds, self.policy.nact, device=device)
        self._index = torch.zeros(config.updates, share, dtype=torch.long, device=device)
        self._weight = torch.full((config.updates, share), 1.0 / config.batch, device=device)
        self._noise = torch.zeros(config.updates, share, 2 * self.policy.nact, device=device)
        self._sums = torch.zeros(4, device=device)
        self._losses = [self.critic_loss, self.actor_loss]
        if config.compiled:
            self._losses = [torch.compile(loss) for loss in self._losses]
        self._learn = Captured(self.learn, team, device)

    @property
    def title(self) -> str:
        """Name of the algorithm, and the size of the replay buffer."""
        size, samples = self.replay.nbytes * self.team.size / 1e9, self.replay.steps * self._all_worlds
        return f"{self.algorithm} with a replay buffer of {samples:,d} samples ({size:.2g} GB)"

    def __next__(self) -> SACIteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer, updates = PhaseTimer(self.env.obs.device), 0
        self._sums.zero_()
        rollout.begin()
        with precision(tf32=config.tf32 and self.env.obs.device.type == "cuda"):
            for _ in range(config.num_steps):
                # 1. Step the worlds, and store the transitions in the replay buffer.
                self.sample()
                timer.mark("sample")

                # 2. Update critics, actor and temperature on samples of the buffer.
                if self.replay.stored * self._all_worlds >= config.warmup:
                    self.draw()
                    self._learn()
                    updates += config.updates
                timer.mark("update")
        self.env.update_shared(team.sum)
        parameters = [self.log_temperature, *self.policy.parameters(), *self.value.parameters()]
        team.copy_leader([*parameters, *self.target.parameters()])

        # copy all numbers to the host at once
        finite = torch.stack([numbers.isfinite().all() for numbers in (self._sums, *parameters)]).all()
        sums = dict(zip(("critic_loss", "q_mean", "actor_loss", "entropy"), self._sums, strict=True))
        numbers = {"finite": finite, "temperature": self.log_temperature.detach().exp(), **sums}
        statistics, (update, *_) = gathered(rollout, team, numbers)
        timer.mark()
        self._check_finite(update)
        update |= {name: update[name] / updates if updates else math.nan for name in sums}

        # 3. Evaluate the mean policy.
        return self._finished(SACIteration, timer, statistics | update, rate_of=("sample", "update"))

    @torch.no_grad()
    def sample(self) -> None:
        """Step every world with an action of the policy, or with a random action during the warm-up."""
        env, noise = self.env, self._act_noise
        if self._warms_up and self.replay.stored * self._all_worlds < self.config.warmup:
            noise.uniform_(-1.0, 1.0, generator=self.generator)
            unit = noise[self.own_worlds]
        else:
            noise.normal_(generator=self.generator)
            unit, _ = self.policy.sample(env.obs, noise[self.own_worlds])
        env.action.copy_(self.policy.scaled(unit))
        self.rollout.store_inputs()
        self.replay.step()
        self.rollout.store_outputs()
        self.policy.observe(env.obs, self.team, eps=_EPS)
        self.value.observe(env.obs_groups[self.value.group], self.team, eps=_EPS)

    @torch.no_grad()
    def draw(self) -> None:
        """Draw the samples and the noise of the updates after a step."""
        team, nworld, batch = self.team, self.env.nworld, self.config.batch
        shape = len(self._index), batch
        random: dict[str, Any] = dict(generator=self.generator, device=self._index.device)
        index = torch.randint(self.replay.count * nworld * team.size, shape, **random)
        noise = torch.randn((*shape, self._noise.shape[-1]), **random)
        # as in Minibatches, put this process's samples first, and drop those that do not fit
        if team.size > 1:
            index, local = team.locate(index, nworld)
            first = local.byte().argsort(dim=1, descending=True, stable=True)[:, : self._index.shape[1]]
            index, noise = index.gather(1, first), noise.gather(1, first[..., None].expand(-1, -1, noise.shape[-1]))
            torch.mul(local.gather(1, first), 1.0 / batch, out=self._weight)
        self._index.copy_(index)
        self._noise.copy_(noise)

    def learn(self) -> None:
        """Make the updates after a step."""
        config, nact = self.config, self.policy.nact
        critic_loss, actor_loss = self._losses
        for i in range(config.updates):
            batch, weight = self.replay.at(self._index[i], n_step=config.n_step, gamma=config.gamma), self._weight[i]
            next_noise, noise = self._noise[i].split(nact, dim=-1)
            if config.symmetry == "augment":
                batch, weight = self._with_images(batch), torch.cat([weight, weight]) / 2.0
                next_noise, noise = torch.cat([next_noise, noise]), torch.cat([noise, next_noise])
            with torch.autocast(weight.device.type, torch.bfloat16, enabled=config.bf16):
                loss, *numbers = critic_loss(batch, weight, next_noise)
            self._sums[:2] += self.critic_step(loss, *numbers)
            if (i + 1) % config.actor_every == 0:
                with torch.autocast(weight.device.type, torch.bfloat16, enabled=config.bf16):
                    loss, *numbers = actor_loss(batch, weight, noise)
                actor_loss_mean, entropy = self.actor_step(loss, *numbers)
                self._sums[2:] += config.actor_every * torch.stack([actor_loss_mean, entropy])
                # too little entropy raises the temperature
                share = (entropy - config.target_entropy * nact) / self.team.size
                self.temperature_step(self.log_temperature * share)
            self._follow(list(self.target.parameters()), list(self.value.parameters()), None)

    def _with_images(self, batch: Transitions) -> Transitions:
        assert self._mirror is not None and self._mirror_value is not None
        images = {"policy": self._mirror.obs, self.value.group: self._mirror_value}

        def both(rows: torch.Tensor, image: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
            return torch.cat([rows, image(rows)])

        return Transitions(
            obs={name: both(batch.obs[name], image) for name, image in images.items()},
            action=both(batch.action, self._mirror.action),
            reward=batch.reward.repeat(2),
            discount=batch.discount.repeat(2),
            next_obs={name: both(batch.next_obs[name], image) for name, image in images.items()},
        )

    def critic_loss(
        self, batch: Transitions, weight: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the sum of the critics' losses, and the mean of the critics' predictions."""
        group, config = self.value.group, self.config
        with torch.no_grad():
            action, log_prob = self.policy.sample(batch.next_obs["policy"], noise)
            entropy = -self.log_temperature.exp() * log_prob
            values = self.target.quantiles(batch.next_obs[group], action)
            if config.quantiles == 1:
                values = self._bound(values)  # (batch, 1)
            else:
                # sort the quantiles of both critics together, and drop the largest
                values = values.transpose(0, 1).flatten(1).sort().values
                values = values[:, : 2 * (config.quantiles - config.dropped_quantiles)]
            target = batch.reward[:, None] + batch.discount[:, None] * (values + entropy[:, None])
        values = self.value.quantiles(batch.obs[group], self.policy.unit(batch.action))
        loss = (values - target).square().sum((0, 2)) if config.quantiles == 1 else quantile_loss(values, target)
        return (weight * loss).sum(), (weight * values.detach().mean((0, 2))).sum()

    def actor_loss(
        self, batch: Transitions, weight: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the actor's loss and entropy."""
        action, log_prob = self.policy.sample(batch.obs["policy"], noise)
        value = self._bound(self.value(batch.obs[self.value.group], action))
        loss = self.log_temperature.detach().exp() * log_prob - value
        if self.config.symmetry == "loss":
            assert self._mirror is not None
            obs = batch.obs["policy"]
            mean = torch.tanh(self.policy(obs)[0])
            image = torch.tanh(self.policy(self._mirror.obs(obs))[0])
            loss = loss + self.config.symmetry_coef * (mean - self._mirror.action(image)).square().mean(-1)
        return (weight * loss).sum(), -(weight * log_prob.detach()).sum()

    def _bound(self, values: torch.Tensor) -> torch.Tensor:
        least = self.config.quantiles == 1 and self.config.critic_bound == "min"
        return values.amin(0) if least else values.mean(0)

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state except ``replay``; see ``Learner``."""
        state = {
            "target": self.target.state_dict(),
            "temperature": self.log_temperature.detach(),
            "optimizers": [step.optimizer.state_dict() for step in self._steps],
            "warms_up": self._warms_up,
        }
        return super().state_dict() | copy.deepcopy(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self.target.load_state_dict(state["target"])
        with torch.no_grad():
            self.log_temperature.copy_(state["temperature"])
        for step, saved in zip(self._steps, state["optimizers"], strict=True):
            step.optimizer.load_state_dict(saved)
        self._learn.forget()  # the graph contains the learning rate
        self._warms_up = state.get("warms_up", self._warms_up)  # missing in runs of release 0.2.0


def action_bounds(env: Env, limit: float) -> tuple[list[float], list[float]]:
    """Get lower and upper bounds of actions, each (nact,). -limit and limit replace infinite bounds."""
    low, high = np.array([env.action_space.low, env.action_space.high], dtype=float)
    return np.where(np.isfinite(low), low, -limit).tolist(), np.where(np.isfinite(high), high, limit).tolist()
