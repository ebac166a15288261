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
from functools import partial
from typing import Any, Literal

import torch
from torch import nn

from lyceum_warp.algos.common.adam import Adam
from lyceum_warp.algos.common.distributed import Branch, Captured, Team
from lyceum_warp.algos.common.hyperparameters import GROUP, PICTURE_RULES, Activation, PictureConfig
from lyceum_warp.algos.common.minibatches import Minibatches, Samples, precision
from lyceum_warp.algos.common.networks import LIMIT, MLP, OUTLIER
from lyceum_warp.algos.common.on_policy import OnPolicyLearner
from lyceum_warp.algos.common.pictures import PictureNetwork, shift_pictures
from lyceum_warp.algos.common.policy import GaussianPolicy, divergence, log_density
from lyceum_warp.algos.common.rollout_statistics import OnPolicyIteration, gathered
from lyceum_warp.algos.common.symmetry import apply_symmetry
from lyceum_warp.algos.common.timing import PhaseTimer, one_thread
from lyceum_warp.algos.common.value import ValueFunction
from lyceum_warp.env import Env, Player
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, whole_number

log = logging.getLogger(__name__)

RECENT = 100

_EPS = 1e-2
"""Constant that is added to the normaliser's standard deviations, as in rsl_rl."""

_SMALLEST_STD = 1e-6

_SAMPLES_A_THREAD = 256
"""Minimum size of a part of a mini-batch; with fewer samples, calls of torch take longer than the arithmetic."""

_SLOWEST, _FASTEST, _FACTOR = 1e-5, 1e-2, 1.5
"""Limits of the adaptive learning rate, and the factor by which the rate changes."""

_RULES: dict[str, Rule] = {
    "num_steps": 1, "epochs": 1, "minibatches": 1, "mean_every": 0, "mean_episodes": 1, "gamma": (0.0, 1.0),
    "lam": (0.0, 1.0), "clip": 0.0, "value_coef": 0.0, "entropy_coef": 0.0, "final_entropy_coef": 0.0,
    "learning_rate": 0.0, "symmetry_coef": 0.0, "desired_kl": 0.0, "max_grad_norm": 0.0, "log_std": (-13.8, 13.8),
    "recurrent": 0, "value_only": 0, "state_coef": 0.0, "value_group": GROUP, **PICTURE_RULES,
}  # fmt: skip


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig(PictureConfig):
    """Hyperparameters of PPO. Except for ``desired_kl``, the defaults are mjlab's settings for legged robots.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    num_steps: int = 24
    """Number of steps of every world per iteration."""
    epochs: int = 5
    """Number of passes over an iteration's samples."""
    minibatches: int = 4
    """Number of mini-batches per epoch, all of the same size. Samples that are left over are not used."""
    gamma: float = 0.99
    """Discount factor."""
    lam: float = 0.95
    """Lambda of the generalised advantage estimate."""
    clip: float = 0.2
    """PPO clips the probability ratio to the range from 1 - clip to 1 + clip. With clip_value_loss, it also clips the
    change of a predicted value to the range from -clip to clip."""
    clip_value_loss: bool = True
    """Whether the value loss is the larger of the prediction's error and the clipped prediction's error."""
    value_only: int = 0
    """Number of first iterations in which only the value function learns, without clip_value_loss. A new value function
    would otherwise ruin a policy that acts well already, such as a student. train --from sets 20 if the run has no
    value function."""
    value_coef: float = 1.0
    """Coefficient of the value loss."""
    entropy_coef: float = 0.01
    """Coefficient of the policy's entropy."""
    final_entropy_coef: float | None = None
    """Entropy coefficient after entropy_decay; by default the coefficient stays constant."""
    entropy_decay: tuple[int, int] = (150, 200)
    """First and last iteration of the linear change from entropy_coef to final_entropy_coef."""
    learning_rate: float = 1e-3
    """Learning rate of Adam, or the initial learning rate if schedule is "adaptive"."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """"adaptive" divides the learning rate by 1.5 if a mini-batch's KL divergence exceeds twice desired_kl, and
    multiplies it by 1.5 if the divergence is below half of desired_kl. The learning rate stays between 1e-5 and
    1e-2."""
    desired_kl: float = 0.02
    """Target KL divergence of the adaptive learning rate. PPO learns go1_velocity faster with 0.02 than with mjlab's
    0.01 (bench/README.md)."""
    max_grad_norm: float = 1.0
    """Maximum Euclidean norm of the gradient, for the policy and the value function separately."""
    whiten_minibatches: bool = False
    """Whether to normalise advantages within each mini-batch instead of over all samples."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the policy's hidden layers."""
    recurrent: int = 0
    """Units of a GRU before the policy's hidden layers, which gives the policy memory; 0 means no memory. The value
    function gets a GRU of this size, too, if it uses the policy's observations. Mini-batches are then sequences: all
    steps of some worlds."""
    activation: Activation = "elu"
    """Activation of the policy's hidden layers."""
    log_std: float = 0.0
    """Initial logarithm of the policy's standard deviations."""
    std_type: Literal["scalar", "log"] = "scalar"
    """Whether Adam learns the standard deviations ("scalar") or their logarithms ("log")."""
    value_hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "elu"
    """Activation of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations for the value function; by default "critic" if the task has this group, else "policy". It
    cannot be a camera, so a policy that sees pictures learns with a value function that knows the state."""
    symmetry: Literal["none", "exact", "loss", "augment"] = "none"
    """How to use the mirror symmetry that a task declares (``lw.Mirror``). "exact" averages the policy with its mirror
    image. "loss" adds a term to the loss: symmetry_coef times the squared difference between the policy and its mirror
    image. "augment" also learns from the mirror images of all samples. "none" ignores the symmetry."""
    symmetry_coef: float = 1.0
    """Coefficient of the symmetry loss, if symmetry is "loss"."""
    state_coef: float = 1.0
    """Coefficient of an additional loss for policies that see cameras: a linear layer must predict the value function's
    normalised observations from the features of the pictures. 0 means no such loss."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance, updated in every step."""
    stagger: bool = True
    """Whether the first episodes start at random steps, so that time limits are spread over time. On the Warp engine,
    this has no effect if the task sets ``lw.Task.settle``."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    half: bool = True
    """Whether networks on a GPU are updated in half precision, whose significand is as long as TensorFloat-32's. This
    applies to the default networks with activation tanh, relu or elu, if tf32 is set."""
    mean_every: int = 20
    """Iterations between evaluations of the mean policy; 0 means no evaluations. A run with fewer iterations than
    ``mean_every`` has no best policy."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        check_fields(self, _RULES)
        object.__setattr__(self, "entropy_decay", _iterations("entropy_decay", self.entropy_decay))

    def entropy_weight(self, iteration: int) -> float:
        """Compute the entropy coefficient of an iteration; the first iteration is number 1."""
        if self.final_entropy_coef is None:
            return self.entropy_coef
        first, last = self.entropy_decay
        share = min(max((iteration - first) / (last - first), 0.0), 1.0)
        return self.entropy_coef + share * (self.final_entropy_coef - self.entropy_coef)


def _iterations(name: str, value: Any) -> tuple[int, int]:
    try:
        first, last = value
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a first and a last iteration, such as (150, 200), not {value!r}") from None
    pair = whole_number(name, first, low=0), whole_number(name, last, low=1)
    if pair[0] >= pair[1]:
        raise ValueError(f"{name} must have a last iteration after the first iteration, not {value!r}")
    return pair


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
    config_type, twice, sees = PPOConfig, False, True
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
        config, team, device = self.config, self.team, env.obs.device
        steps, nworld = config.num_steps, env.nworld * team.size
        # with a last layer near zero, as in NPG, the adaptive learning rate would be much too high at first
        limit = OUTLIER if config.normalize else LIMIT  # float16 overflows in a layer from about 1,000 deviations
        self._make_networks(policy, value, scale=1.0, limit=limit, as_torch=True)
        self._recurrent = self.policy.state_size + self.value.state_size > 0
        if self._recurrent and config.symmetry != "none":
            what = "cameras" if self.policy.pictures else "memory"
            raise ValueError(
                f"symmetry={config.symmetry!r} needs a policy without {what}: use symmetry='none' (--symmetry none)"
            )
        self._length = steps if self._recurrent else 1  # steps of a sequence, which stays together in a mini-batch
        self._burn_in = getattr(self.policy.network, "burn_in", 0)
        if self._burn_in >= steps:
            raise ValueError(f"num_steps={steps} must be at least frames, which is {self._burn_in + 1}")
        count, items = steps * nworld // self._length, "worlds" if self._recurrent else "samples"
        if config.minibatches > count:
            raise ValueError(
                f"{config.minibatches} mini-batches need at least {config.minibatches} {items}, not {count}: use more "
                "worlds or fewer mini-batches"
            )
        if (excess := count % config.minibatches) and team.leads:
            log.warning(
                "%d mini-batches of equal size hold only %d of %d %s: make the number of mini-batches divide %d",
                config.minibatches, count - excess, count, items, count,
            )  # fmt: skip
        if self.policy.mirror is not None:
            config = self.config = dataclasses.replace(config, symmetry="exact")
        self._mirror, self._mirror_value = apply_symmetry(config.symmetry, env, self.policy, self.value.group)
        self._make_rollout(steps)
        self.noise = torch.empty(steps, nworld, env.action_space.size, device=device)
        self._mean = torch.empty_like(env.action)
        self._means = self.rollout.store_too(self._mean)
        self._act = Captured(self._choose, team, device)
        self._observe = Captured(self._update_normalizers, team, device)
        self._player = Player(self.policy, env)
        self._first = torch.zeros_like(self._player.state)  # the policy's states before the rollout
        self._value_state = torch.zeros(env.nworld, self.value.state_size, device=device)

        # the update
        self._predictor: nn.Linear | None = None
        if config.state_coef and isinstance(self.policy.network, PictureNetwork):
            self._predictor = nn.Linear(self.policy.network.size, env.obs_spaces[self.value.group].size, device=device)
            nn.init.zeros_(self._predictor.weight)
            nn.init.zeros_(self._predictor.bias)
        log_std = self.policy.log_std
        self.std = log_std if config.std_type == "log" else nn.Parameter(log_std.detach().exp())
        self.std.requires_grad_(log_std.requires_grad)
        predicting = () if self._predictor is None else self._predictor.parameters()
        acting = [self.std, *(p for p in self.policy.parameters() if p is not log_std), *predicting]
        learned = [[p for p in group if p.requires_grad] for group in (acting, self.value.parameters())]
        self._acting, self._parameters = learned[0], [p for group in learned for p in group]
        self.rate = torch.tensor(config.learning_rate, device=device)
        self._cuda = device.type == "cuda"
        self.optimizer = Adam(self._parameters, self.rate, numbers=4)
        self._sums = self.optimizer.sums
        sizes = [sum(p.numel() for p in group) for group in learned]
        self._gradients = self.optimizer.gradient.split(sizes)
        self._branch = Branch(device)
        self._losses = torch.zeros(3, device=device)
        self._entropy_coef = torch.zeros((), device=device)
        self._value_clip = torch.zeros((), device=device)
        self._old_log_std = log_std.detach().clone()
        self.minibatches = Minibatches(
            self.learn, steps=steps // self._length, nworld=env.nworld, count=config.minibatches, team=team,
            device=device,
        )  # fmt: skip
        # on a CPU, each thread differentiates a part of a mini-batch
        samples, threads = self.minibatches.room * self._length, 1 if self._cuda else torch.get_num_threads()
        parts = max(1, min(threads, samples // _SAMPLES_A_THREAD))
        self._workers = Workers(parts)
        self._part_sums = [self._sums, *(torch.zeros_like(self._sums) for _ in range(parts - 1))]

        self._recent: collections.deque[float] = collections.deque(maxlen=RECENT)
        self.rollout.restart()
        if config.stagger:
            self.rollout.stagger(self.generator, team)

    def __next__(self) -> PPOIteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer = PhaseTimer(self.env.obs.device)
        with precision(tf32=config.tf32 and self._cuda, half=config.half and config.tf32 and self._cuda):
            # 1. Collect samples.
            self.sample()
            self.env.update_shared(team.sum)

            # 2. Compute values and advantages.
            samples = self.evaluated_samples()
            timer.mark("sample")

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
        update["return_recent"] = sum(self._recent) / len(self._recent) if self._recent else math.nan
        timer.mark("update")
        self._check_finite(update)

        # 4. Evaluate the mean policy.
        return self._finished(PPOIteration, timer, statistics | update, rate_of=("sample",))

    @torch.no_grad()
    def sample(self) -> None:
        """Fill the rollout buffer with samples of the current policy.

        After each step, the normalisers are updated with the step's observations.
        """
        with one_thread():
            self.noise.normal_(generator=self.generator)
            self.policy.observe_pictures(self.env.obs_groups, self.team)
            self._first.copy_(self._player.state)
            self.rollout.fill(self._act, self._observe)

    @torch.no_grad()
    def _choose(self) -> None:
        """Draw actions from the policy."""
        noise = self.noise.index_select(0, self.rollout.index)[0, self.own_worlds]
        self._mean.copy_(self._player(self.env.obs))
        torch.addcmul(self._mean, noise, self.policy.log_std.exp(), out=self.env.action)

    def _update_normalizers(self) -> None:
        self.policy.observe(self.env.obs, self.team, eps=_EPS)
        self.value.observe(self.env.obs_groups[self.value.group], self.team, eps=_EPS)

    @torch.no_grad()
    def evaluated_samples(self) -> dict[str, torch.Tensor]:
        """Compute the inputs of the update, each (steps, nworld, ...), or (1, nworld, ...) for states.

        The value function's targets are its predictions plus the advantages. Advantages bootstrap from the observation
        right after a step, before events such as a push or a new command. Advantages thus exclude the effects of
        events, which the action does not cause. Advantages also bootstrap at time limits, at faults and at the end of
        the rollout.
        """
        rollout, config, team = self.rollout, self.config, self.team
        obs, final_obs = rollout.obs_groups[self.value.group], rollout.final_obs_groups[self.value.group]
        before = self._value_state
        value, states = self.value.unrolled(obs, rollout.step, before, rollout.step == 0.0)
        next_value, self._value_state = self.value(final_obs, rollout.step + 1.0, states), states[-1]
        advantage, _ = self._estimate(rollout.reward, value, next_value)
        target = value + advantage
        if not config.whiten_minibatches:
            advantage = advantage - team.sum(advantage.sum()) / self.count
            variance = team.sum(advantage.square().sum()) / max(self.count - 1, 1)
            advantage = advantage / (variance.sqrt() + 1e-8)
        self._old_log_std.copy_(self.policy.log_std)
        seen = {f"obs/{group}": rollout.obs_groups[group] for group in self.policy.groups}
        samples = {
            **(seen if self.policy.pictures else {"obs": rollout.obs}), "value_obs": obs, "step": rollout.step,
            "action": rollout.action, "mean": self._means,
            "log_prob": log_density(rollout.action, self._means, self._old_log_std), "value": value, "target": target,
            "advantage": advantage,
        }  # fmt: skip
        return samples | {"state": self._first[None], "value_state": before[None]} if self._recurrent else samples

    def update(self, samples: Samples) -> None:
        """Run the epochs of mini-batches."""
        config, team, length = self.config, self.team, self._length
        for group in self.policy.pictures if config.random_shift else ():
            shift_pictures(samples[f"obs/{group}"], config.random_shift, self.generator)
        if self._recurrent:  # for the mini-batches, a sequence is one sample
            samples = {name: part.transpose(0, 1)[None] for name, part in samples.items()}
        parts = self.minibatches.shuffle(samples, self.generator)
        if config.whiten_minibatches:
            advantage = parts["advantage"].flatten(1)
            weight = self.minibatches.weight.repeat_interleave(length, 1) / length
            advantage -= team.sum((weight * advantage).sum(1, keepdim=True))
            variance = team.sum((weight * advantage.square()).sum(1, keepdim=True))
            batch = self.minibatches.batch * length
            advantage /= (variance * (batch / max(batch - 1, 1))).sqrt() + 1e-8
        self._entropy_coef.fill_(config.entropy_weight(self.iteration + 1))
        self._losses.zero_()
        alone = self.iteration < config.value_only
        self._value_clip.fill_(math.inf if alone else config.clip)
        before = [p.detach().clone() for p in self._acting if alone]
        with one_thread():
            for _ in range(config.epochs):
                self.minibatches.epoch()
        if alone:  # the policy has moved, so that the learning rate adapts
            for parameter, old in zip(self._acting, before, strict=True):
                parameter.detach().copy_(old)
        team.copy_leader(self._parameters)
        self._apply_std()

    def learn(self, samples: Samples, weight: torch.Tensor) -> None:
        """Make one step of Adam on a mini-batch."""
        config, parts = self.config, len(self._part_sums)
        split = {name: rows.tensor_split(parts) for name, rows in samples.items()}
        self._workers.run([
            partial(self._differentiate, {name: rows[i] for name, rows in split.items()}, part, sums)
            for i, (part, sums) in enumerate(zip(weight.tensor_split(parts), self._part_sums, strict=True))
        ])  # fmt: skip
        with torch.no_grad():
            for sums in self._part_sums[1:]:
                self._sums += sums
            self.team.sum(self._sums)
            if config.schedule == "adaptive":
                self._adapt(self._sums[-4])
            for gradient in self._gradients:
                gradient *= (config.max_grad_norm / (torch.linalg.vector_norm(gradient) + 1e-6)).clamp_max(1.0)
            self.optimizer.step()
            self._losses += self._sums[-3:]

    def _differentiate(self, samples: Samples, weight: torch.Tensor, sums_out: torch.Tensor) -> None:
        """Compute the gradient, the KL divergence and the losses of weighted samples."""
        config, clip = self.config, self.config.clip
        if self._recurrent:
            samples = {name: part.transpose(0, 1) for name, part in samples.items()}
            weight = (weight / (self._length - self._burn_in)).repeat(self._length, 1)
            weight[: self._burn_in] = 0.0
        old_mean, kl_weight = samples["mean"], weight
        if config.symmetry == "augment":
            samples, weight = self._with_images(samples), torch.cat([weight, weight]) / 2.0
        with self._branch:
            value = self._value_of(samples)
            error = (value - samples["target"]).square()
            if config.clip_value_loss:
                change = (value - samples["value"]).clamp(-self._value_clip, self._value_clip)
                clipped = samples["value"] + change
                error = torch.max(error, (clipped - samples["target"]).square())
            value_loss = (weight * error).sum()
        mean, prediction_loss = self._mean_of(samples, weight)
        log_std = self._log_std()
        ratio = torch.exp(log_density(samples["action"], mean, log_std) - samples["log_prob"])
        advantage = samples["advantage"]
        surrogate = torch.max(-advantage * ratio, -advantage * ratio.clamp(1.0 - clip, 1.0 + clip))
        entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
        surrogate_loss = (weight * surrogate).sum()
        self._branch.join()
        losses = torch.stack([value_loss, surrogate_loss, weight.sum() * entropy])
        loss = config.value_coef * losses[0] + losses[1] - self._entropy_coef * losses[2] + prediction_loss
        if config.symmetry == "loss":
            assert self._mirror is not None
            image = self._mirror.action(self.policy(self._mirror.obs(samples["obs"])))
            loss = loss + config.symmetry_coef * (weight * (mean - image).square().mean(-1)).sum()
        scale = float(self.minibatches.batch * self._length) if MLP.in_half else 1.0
        # backward() accumulates on the CUDA stream of its first call
        gradients = torch.autograd.grad(scale * loss, self._parameters)

        with torch.no_grad():
            # an image's old mean is not the policy's: KL divergences of images would measure the policy's asymmetry
            kl = (kl_weight * divergence(old_mean, self._old_log_std, mean[: len(old_mean)], log_std)).sum()
            torch.cat([*(part.flatten() for part in gradients), kl[None], losses], out=sums_out)
            sums_out[: len(self.optimizer.gradient)] /= scale

    def _mean_of(self, samples: Samples, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | float]:
        """Compute the mean actions of a mini-batch, and the loss of the predicted state."""
        policy = self.policy
        if not self._recurrent:
            return policy(samples["obs"]), 0.0
        began, state = samples["step"] == 0.0, samples["state"][0]
        if not policy.pictures:
            return policy.unrolled(samples["obs"], state, began)[0], 0.0
        obs = policy.inputs({group: samples[f"obs/{group}"] for group in policy.groups})
        if self._predictor is None:
            return policy.unrolled(obs, state, began)[0], 0.0
        features = policy.features(obs, state, began)
        with torch.no_grad():
            truth = self.value.normalizer(samples["value_obs"])
        error = (self._predictor(features) - truth).square().mean(-1)
        return policy.network.network(features), self.config.state_coef * (weight * error).sum()  # type: ignore[operator]

    def _value_of(self, samples: Samples) -> torch.Tensor:
        """Predict the values of a mini-batch."""
        obs, step = samples["value_obs"], samples["step"]
        if not self._recurrent:
            return self.value(obs, step)
        value, _ = self.value.unrolled(obs, step, samples["value_state"][0], step == 0.0)
        return value

    def _with_images(self, samples: Samples) -> dict[str, torch.Tensor]:
        """Append the mirror images of samples; an image has the same density as its original."""
        assert self._mirror is not None and self._mirror_value is not None
        mirrors = {"obs": self._mirror.obs, "value_obs": self._mirror_value, "action": self._mirror.action}
        images = {name: mirror(samples[name]) for name, mirror in mirrors.items()}
        return {name: torch.cat([part, images.get(name, part)]) for name, part in samples.items()}

    def _adapt(self, kl: torch.Tensor) -> None:
        desired = self.config.desired_kl
        lower, higher = (self.rate / _FACTOR).clamp_min(_SLOWEST), (self.rate * _FACTOR).clamp_max(_FASTEST)
        rate = torch.where((kl < desired / 2.0) & (kl > 0.0), higher, self.rate)
        self.rate.copy_(torch.where(kl > desired * 2.0, lower, rate))

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
        """Compute the KL divergence from the old to the current policy, averaged over the samples.

        A policy that sees cameras goes on with the state that its new encoders compute.
        """
        rollout, policy, after = self.rollout, self.policy, slice(self._burn_in, None)
        mean, states = policy.unrolled(policy.inputs(rollout.obs_groups), self._first, rollout.step == 0.0)
        if policy.pictures:  # go on with the features of the new encoders
            self._player.state.copy_(states[-1])
        kl = divergence(self._means[after], self._old_log_std, mean[after], policy.log_std).mean()
        return self.team.sum(kl) / self.team.size

    def _returns(self) -> list[float]:
        """Get the returns of the ended episodes of all processes, ordered by step."""
        returns = self.rollout.episode_return.masked_fill(~self.rollout.done, torch.nan)
        returns = self.team.gather(returns.T).T
        return list(returns[~returns.isnan()].tolist())

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state; see ``Learner``."""
        state = {"optimizer": self.optimizer.state_dict(), "std": self.std.detach(), "recent": list(self._recent)}
        if self._predictor is not None:
            state["predictor"] = self._predictor.state_dict()
        if self._recurrent:
            state["memory"] = [self.team.gather(part) for part in (self._player.state, self._value_state)]
        return super().state_dict() | copy.deepcopy(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self.optimizer.load_state_dict(state["optimizer"])
        if self._predictor is not None:
            self._predictor.load_state_dict(state["predictor"])
        with torch.no_grad():
            self.std.copy_(state["std"])
        self._recent.clear()
        self._recent.extend(state["recent"])
        if self._recurrent:
            parts = [part[self.own_worlds].to(self.env.obs.device) for part in state["memory"]]
            self._player.state.copy_(parts[0])
            self._value_state = parts[1]
