"""Learn policies by proximal policy optimisation (PPO).

PPO was proposed by Schulman et al., 2017 ("Proximal Policy Optimization Algorithms"). This implementation follows
rsl_rl (Rudin et al. 2022, "Learning to Walk in Minutes Using Massively Parallel Deep Reinforcement Learning"): a
clipped value loss, a learning rate adapted to the KL divergence, and the same mini-batches in every epoch.
"""

import collections
import copy
import dataclasses
import logging
import math
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.minibatches import Minibatches, Samples, precision
from lyceum_warp.algos.common.networks import LIMIT
from lyceum_warp.algos.common.on_policy import OnPolicyLearner
from lyceum_warp.algos.common.policy import GaussianPolicy, divergence, log_density
from lyceum_warp.algos.common.rollout_statistics import OnPolicyIteration, gathered
from lyceum_warp.algos.common.symmetry import apply_symmetry
from lyceum_warp.algos.common.timing import PhaseTimer, one_thread
from lyceum_warp.algos.common.value import ValueFunction
from lyceum_warp.algos.ppo_config import PPOConfig
from lyceum_warp.env.env import Env
from lyceum_warp.support.docstrings import document_attributes

log = logging.getLogger(__name__)

RECENT = 100

_EPS = 1e-2
"""Constant that is added to the normaliser's standard deviations, as in rsl_rl."""

_SMALLEST_STD = 1e-6

_SLOWEST, _FASTEST, _FACTOR = 1e-5, 1e-2, 1.5
"""Limits of the adaptive learning rate, and the factor by which the rate changes."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOIteration(OnPolicyIteration):
    """Statistics of one iteration of PPO.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended. If ``stagger``
    is set, they exclude each world's first episode, which starts at a random step.
    """

    return_recent: float
    """Mean return of the last 100 episodes, including episodes of earlier iterations."""
    learning_rate: float
    """Learning rate after the iteration."""
    surrogate_loss: float
    """Mean of the clipped surrogate loss over the mini-batches."""
    entropy: float
    """Mean entropy of the policy over the mini-batches."""
    value_loss: float
    """Mean of the value function's loss over the mini-batches."""
    time_update: float
    """Seconds for the update."""


@document_attributes
class PPO(OnPolicyLearner):
    """Infinite iterator of ``PPOIteration`` that learns a policy by PPO.

    Example:
        >>> for it in PPO(env, config=PPOConfig(hidden=(64, 64))):
        ...     print(it.return_recent)

    Args:
        env: The environment, which must not be stepped between iterations.
        policy: The policy; by default a new policy. ``GaussianPolicy(nobs, nact, network=...)`` wraps any network.
        value: The value function; by default a new value function.
        config: Hyperparameters.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together, each with some of the worlds. All processes must make the same calls
            with the same arguments; all get the same statistics.

    Raises:
        ValueError: The environment does not reset automatically, an argument is of the wrong type, or the policy is not
            trainable (``lyceum_warp.algos.common.policy_check``).
        FloatingPointError: A loss, or a parameter of a network, is not finite after an iteration.
    """

    algorithm = "ppo"
    """The name of the algorithm in a run's config.json."""
    config_type, twice = PPOConfig, False
    config: PPOConfig
    """Hyperparameters."""
    rate: torch.Tensor
    """The learning rate, as a tensor on the device."""

    def __init__(
        self,
        env: Env,
        policy: GaussianPolicy | None = None,
        value: ValueFunction | None = None,
        config: PPOConfig | None = None,
        *,
        seed: int = 0,
        team: Team | None = None,
    ) -> None:
        super().__init__(env, policy, value, config, seed=seed, team=team)
        config, team, device, steps = self.config, self.team, env.obs.device, self.config.num_steps
        if config.minibatches > (count := steps * env.nworld * team.size):
            raise ValueError(
                f"{config.minibatches} mini-batches need at least {config.minibatches} samples, not {count}: use more "
                "worlds or fewer mini-batches"
            )
        if (rest := count % config.minibatches) and team.leads:
            log.warning(
                "%d mini-batches of equal size hold only %d of %d samples: make the number of mini-batches divide %d",
                config.minibatches, count - rest, count, count,
            )  # fmt: skip
        # with a last layer near zero, as in NPG, the adaptive learning rate would be much too high at first
        limit = math.inf if config.normalize else LIMIT
        self._make_networks(policy, value, scale=1.0, limit=limit, as_torch=True)
        if self.policy.mirror is not None:
            config = self.config = dataclasses.replace(config, symmetry="exact")
        self._mirror, self._mirror_value = apply_symmetry(config.symmetry, env, self.policy, self.value.group)
        self._make_rollout(steps)
        self.noise = torch.empty(steps, env.nworld * team.size, env.action_space.size, device=device)
        self._mean = torch.empty_like(self.rollout.action)

        # the update
        log_std = self.policy.log_std
        self.std = log_std if config.std_type == "log" else nn.Parameter(log_std.detach().exp())
        self.std.requires_grad_(log_std.requires_grad)
        own = [self.std, *(p for p in self.policy.parameters() if p is not log_std)]
        self._learned = [[p for p in group if p.requires_grad] for group in (own, self.value.parameters())]
        self._parameters = [p for group in self._learned for p in group]
        self.rate = torch.tensor(config.learning_rate, device=device)
        self._cuda = device.type == "cuda"
        self.optimizer = torch.optim.Adam(self._parameters, lr=self.rate, fused=True, capturable=self._cuda)
        # with one tensor, one all-reduce suffices
        sizes = [p.numel() for p in self._parameters]
        self._sums = self._parameters[0].new_zeros(sum(sizes) + 4)
        for parameter, part in zip(self._parameters, self._sums[:-4].split(sizes), strict=True):
            parameter.grad = part.view_as(parameter)
        self._losses, self._entropy_coef = torch.zeros(3, device=device), torch.zeros((), device=device)
        self._old_log_std = log_std.detach().clone()
        self.minibatches = Minibatches(
            self.learn, steps=steps, nworld=env.nworld, count=config.minibatches, team=team, device=device
        )

        self._recent: collections.deque[float] = collections.deque(maxlen=RECENT)
        self.rollout.restart()
        if config.stagger:
            self.rollout.stagger(self.generator, team)

    def __next__(self) -> PPOIteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer = PhaseTimer(self.env.obs.device)
        with precision(tf32=config.tf32 and self._cuda):
            # 1. Collect samples.
            self.sample()
            self.env.update_shared(team.sum)

            # 2. Compute values and advantages.
            samples = self.evaluated_samples()
            timer.mark()

            # 3. Run the epochs.
            self.update(samples)
            kl = self.divergence()

        # copy all numbers to the host at once
        losses = self._losses / (config.epochs * config.minibatches)
        finite = torch.stack([numbers.isfinite().all() for numbers in (losses, *self._parameters)]).all()
        statistics, (update, *_) = gathered(rollout, team, {
            "finite": finite, "kl": kl, "std_mean": self.policy.log_std.detach().exp().mean(),
            "learning_rate": self.rate, "value_loss": losses[0], "surrogate_loss": losses[1], "entropy": losses[2],
        })  # fmt: skip
        self._recent.extend(self._returns()[-RECENT:])
        timer.mark()
        if not update.pop("finite"):
            raise FloatingPointError(
                f"the update of iteration {self.iteration + 1} is not finite: make learning_rate, or the rewards and "
                f"observations, smaller ({rollout.extremes()})"
            )

        # 4. Evaluate the mean policy.
        self.iteration += 1
        self.samples += self.count
        statistics = self._evaluate_mean.added(statistics, self.policy, self.iteration)
        timer.mark()

        time_sample, time_update, time_mean = timer.seconds()
        return PPOIteration(
            iteration=self.iteration,
            samples=self.samples,
            **statistics,
            **update,
            return_recent=sum(self._recent) / len(self._recent) if self._recent else math.nan,
            time_sample=time_sample,
            time_update=time_update,
            time_mean=time_mean,
            samples_per_second=self.count / time_sample,
        )

    @torch.no_grad()
    def sample(self) -> None:
        """Fill the rollout buffer with samples of the current policy.

        After each step, the normalisers are updated with the step's observations.
        """
        env, rollout, std = self.env, self.rollout, self.policy.log_std.exp()
        with one_thread():
            self.noise.normal_(generator=self.generator)
            noise = self.noise[:, self.own_worlds]
            rollout.begin()
            for t in range(rollout.steps):
                self._mean[t] = self.policy(env.obs)
                torch.addcmul(self._mean[t], noise[t], std, out=env.action)
                rollout.store_inputs()
                env.step()
                rollout.store_outputs()
                self.policy.observe(env.obs, self.team, eps=_EPS)
                self.value.observe(env.obs_groups[self.value.group], self.team, eps=_EPS)

    @torch.no_grad()
    def evaluated_samples(self) -> dict[str, torch.Tensor]:
        """Compute the inputs of the update, each (steps, nworld, ...).

        The value function's targets are its predictions plus the advantages. Advantages bootstrap from the observation
        right after a step, before events such as a push or a new command. Advantages thus exclude the effects of
        events, which the action does not cause. Advantages also bootstrap at time limits, at faults and at the end of
        the rollout.
        """
        rollout, config, team = self.rollout, self.config, self.team
        obs, final_obs = rollout.obs_groups[self.value.group], rollout.final_obs_groups[self.value.group]
        value, next_value = self.value(obs, rollout.step), self.value(final_obs, rollout.step + 1.0)
        advantage, _ = self._estimate(rollout.reward, value, next_value)
        target = value + advantage
        if not config.whiten_minibatches:
            advantage = advantage - team.sum(advantage.sum()) / self.count
            variance = team.sum(advantage.square().sum()) / max(self.count - 1, 1)
            advantage = advantage / (variance.sqrt() + 1e-8)
        self._old_log_std.copy_(self.policy.log_std)
        return {
            "obs": rollout.obs, "value_obs": obs, "step": rollout.step, "action": rollout.action, "mean": self._mean,
            "log_prob": log_density(rollout.action, self._mean, self._old_log_std), "value": value, "target": target,
            "advantage": advantage,
        }  # fmt: skip

    def update(self, samples: Samples) -> None:
        """Run the epochs of mini-batches."""
        config, team = self.config, self.team
        parts = self.minibatches.shuffle(samples, self.generator)
        if config.whiten_minibatches:
            advantage, weight = parts["advantage"], self.minibatches.weight
            advantage -= team.sum((weight * advantage).sum(1, keepdim=True))
            variance = team.sum((weight * advantage.square()).sum(1, keepdim=True))
            batch = self.minibatches.batch
            advantage /= (variance * (batch / max(batch - 1, 1))).sqrt() + 1e-8
        self._entropy_coef.fill_(config.entropy_weight(self.iteration + 1))
        self._losses.zero_()
        for _ in range(config.epochs):
            self.minibatches.epoch()
        team.copy_leader(self._parameters)
        self._apply_std()

    def learn(self, samples: Samples, weight: torch.Tensor) -> None:
        """Make one step of Adam on a mini-batch."""
        config, clip = self.config, self.config.clip
        old_mean, own_weight = samples["mean"], weight
        if config.symmetry == "augment":
            samples, weight = self._with_images(samples), torch.cat([weight, weight]) / 2.0
        mean, log_std = self.policy(samples["obs"]), self._log_std()
        ratio = torch.exp(log_density(samples["action"], mean, log_std) - samples["log_prob"])
        advantage = samples["advantage"]
        surrogate = torch.max(-advantage * ratio, -advantage * ratio.clamp(1.0 - clip, 1.0 + clip))
        value = self.value(samples["value_obs"], samples["step"])
        error = (value - samples["target"]).square()
        if config.clip_value_loss:
            near = samples["value"] + (value - samples["value"]).clamp(-clip, clip)
            error = torch.max(error, (near - samples["target"]).square())
        entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
        losses = torch.stack([(weight * error).sum(), (weight * surrogate).sum(), weight.sum() * entropy])
        loss = config.value_coef * losses[0] + losses[1] - self._entropy_coef * losses[2]
        if config.symmetry == "loss":
            assert self._mirror is not None
            image = self._mirror.action(self.policy(self._mirror.obs(samples["obs"])))
            loss = loss + config.symmetry_coef * (weight * (mean - image).square().mean(-1)).sum()
        # backward() accumulates on the CUDA stream of its first call
        gradients = torch.autograd.grad(loss, self._parameters)

        with torch.no_grad():
            # an image's old mean is not the policy's: KL divergences of images would measure the policy's asymmetry
            kl = (own_weight * divergence(old_mean, self._old_log_std, mean[: len(old_mean)], log_std)).sum()
            torch.cat([*(part.flatten() for part in gradients), kl[None], losses], out=self._sums)
            self.team.sum(self._sums)
            if config.schedule == "adaptive":
                self._adapt(self._sums[-4])
            for parameters in self._learned:
                nn.utils.clip_grad_norm_(parameters, config.max_grad_norm)
            self.optimizer.step()
            self._losses += self._sums[-3:]

    def _with_images(self, samples: Samples) -> dict[str, torch.Tensor]:
        """Append the mirror images of samples; an image has the same density as its original."""
        assert self._mirror is not None and self._mirror_value is not None
        images = dict(samples)
        for name, image in (("obs", self._mirror.obs), ("value_obs", self._mirror_value),
                            ("action", self._mirror.action)):  # fmt: skip
            images[name] = image(samples[name])
        return {name: torch.cat([part, images[name]]) for name, part in samples.items()}

    def _adapt(self, kl: torch.Tensor) -> None:
        wanted = self.config.desired_kl
        lower, higher = (self.rate / _FACTOR).clamp_min(_SLOWEST), (self.rate * _FACTOR).clamp_max(_FASTEST)
        raised = torch.where((kl < wanted / 2.0) & (kl > 0.0), higher, self.rate)
        self.rate.copy_(torch.where(kl > wanted * 2.0, lower, raised))

    def _log_std(self) -> torch.Tensor:
        if self.config.std_type == "log":
            log_std = self.std.clamp_min(math.log(_SMALLEST_STD))
        else:
            log_std = self.std.clamp_min(_SMALLEST_STD).log()
        if self.policy.mirror is None:
            return log_std
        return 0.5 * (log_std + self.policy.mirror.action.swapped(log_std))

    @torch.no_grad()
    def _apply_std(self) -> None:
        self.policy.log_std.copy_(self._log_std())

    @torch.no_grad()
    def divergence(self) -> torch.Tensor:
        """Compute the KL divergence from the old to the current policy, averaged over the samples."""
        kl = divergence(self._mean, self._old_log_std, self.policy(self.rollout.obs), self.policy.log_std).mean()
        return self.team.sum(kl) / self.team.size

    def _returns(self) -> list[float]:
        """Get the returns of the ended episodes of all processes, ordered by step."""
        ended = self.rollout.episode_return.masked_fill(~self.rollout.done, torch.nan)
        ended = self.team.gather(ended.T).T
        found: list[float] = ended[~ended.isnan()].tolist()
        return found

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state; see ``Learner``."""
        own = {
            "optimizer": self.optimizer.state_dict(),
            "std": self.std.detach(),
            "recent": list(self._recent),
        }
        return super().state_dict() | copy.deepcopy(own)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self.optimizer.load_state_dict(state["optimizer"])
        for group in self.optimizer.param_groups:
            self.rate.copy_(group["lr"])
            group["lr"], group["capturable"] = self.rate, self._cuda
        with torch.no_grad():
            self.std.copy_(state["std"])
        self._recent.clear()
        self._recent.extend(state["recent"])
        self.minibatches.epoch.forget()  # the graph contains the addresses of Adam's old moments
