"""Learn policies by natural policy gradient (NPG).

NPG was proposed by Kakade (2002). This implementation follows Rajeswaran et al., 2017 ("Towards Generalization and
Simplicity in Continuous Control"): generalised advantages, conjugate gradient on the Fisher information, and a step of
fixed length in the Fisher metric.
"""

import copy
import dataclasses
import functools
import logging
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch

from lyceum_warp.algos.common.dense import dense_policy, predict
from lyceum_warp.algos.common.distributed import Team, unflatten
from lyceum_warp.algos.common.hyperparameters import GROUP, LEAST, Activation
from lyceum_warp.algos.common.networks import Normalizer
from lyceum_warp.algos.common.on_policy import OnPolicyLearner
from lyceum_warp.algos.common.policy import GaussianPolicy, divergence
from lyceum_warp.algos.common.rollout_statistics import OnPolicyIteration, gathered, pooled
from lyceum_warp.algos.common.timing import PhaseTimer, beside, one_thread
from lyceum_warp.algos.common.value import BOUND, ValueFunction
from lyceum_warp.algos.common.value_fit import ValueFit
from lyceum_warp.algos.natural_gradient import FisherProduct, conjugate_gradient, score_gradient
from lyceum_warp.env.env import Env
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields

log = logging.getLogger(__name__)

_SHORTER = 4
"""Maximum number of times that NPG shortens a step."""

_PATIENCE = 10
"""Learning ends after this number of consecutive iterations with a non-finite update."""

_DRIFT = 0.2
"""Maximum KL divergence that an update of the normaliser may cause, as a fraction of the desired KL divergence."""


_RULES: dict[str, Rule] = {
    "samples": 1, "cg_iterations": 1, "value_epochs": 0, "value_batch": 1, "time_orders": 0, "mean_every": 0,
    "mean_episodes": 1, "gamma": (0.0, 1.0), "lam": (0.0, 1.0), "delta": 0.0, "damping": 0.0,
    "fisher_fraction": (0.0, 1.0), "kl_limit": 1.0, "log_std": LEAST, "min_log_std": LEAST, "value_rate": 0.0,
    "min_restarts": 0.0, "value_group": GROUP,
}  # fmt: skip

_LONG_EPISODE = 20
"""If an episode takes more iterations than this limit, NPG restarts worlds by default (``min_restarts``). When an
episode of hopper took 31 or 63 iterations, the return of some seeds stayed low for a long time. This did not happen
when an episode took 16 iterations (bench/README.md, "NPG's learning curves")."""


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGConfig:
    """Hyperparameters of NPG. The defaults follow Rajeswaran et al., 2017, except as noted.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    samples: int | None = None
    """Samples per iteration, rounded up to a multiple of the number of worlds. The default is 16 steps of every world,
    but at least 10,000 samples, as in the paper."""
    rollout: Literal["auto", "episodes", "segments"] = "auto"
    """"episodes" starts new episodes in every iteration, as in the paper. "segments" continues the last iteration's
    episodes, which suits many worlds with few steps each. "auto" selects "episodes" if samples / worlds >= horizon, and
    otherwise "segments"."""
    min_restarts: float | None = None
    """Minimum number of worlds that start an episode in each iteration, as a multiple of samples / horizon; 0 turns
    restarts off. If too few worlds started an episode in the last iteration, NPG restarts random worlds. Restarts
    require "segments" and a time limit. Without restarts, worlds that started together reach the time limit together.
    Until then, few samples come from the start of an episode. The statistics exclude interrupted episodes. A value well
    above 1 therefore biases ``return_mean`` towards short episodes. The default is 0.5 if an episode takes more than 20
    iterations, and 0 otherwise."""
    gamma: float = 0.995
    """Discount factor."""
    lam: float = 0.97
    """Lambda of the generalised advantage estimate."""
    delta: float = 0.1
    """Squared length of a step in the Fisher metric, which is twice the KL divergence between the old and the new
    policy."""
    whiten: bool = True
    """Whether to normalise advantages to mean 0 and standard deviation 1 (as in mjrl, unlike Lyceum)."""
    cg_iterations: int = 10
    """Number of conjugate gradient iterations."""
    damping: float = 1e-4
    """Damping, added to the diagonal of the Fisher information (as in mjrl, unlike Lyceum)."""
    fisher_fraction: float = 1.0
    """Fraction of the samples from which NPG computes the Fisher information. NPG draws these samples at random in each
    iteration."""
    kl_limit: float = 1.5
    """Maximum KL divergence of a step, as a multiple of delta / 2. NPG shortens steps that exceed this limit."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    activation: Activation = "tanh"
    """Activation of the policy's hidden layers."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviations."""
    min_log_std: float = -3.0
    """Lower limit of ``log_std`` during learning (as in mjrl, unlike Lyceum)."""
    value_hidden: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "tanh"
    """Activation of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations for the value function; by default "critic" if the task has this group, else "policy"."""
    value_epochs: int = 2
    """Epochs of the value function's fit."""
    value_batch: int | None = None
    """Mini-batch size of the value function's fit; by default 1/256 of all samples, but at least the paper's 64."""
    value_rate: float = 1e-3
    """Learning rate of the value function's fit (Adam)."""
    time_orders: int = 0
    """Highest power of the value function's time feature; 0 means no time feature."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance (unlike the paper)."""
    mean_every: int = 10
    """Iterations between evaluations of the mean policy; 0 means no evaluations."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        check_fields(self, _RULES)
        if self.fisher_fraction == 0.0:
            raise ValueError("fisher_fraction must be greater than 0, such as 0.1 for every tenth sample")
        if self.log_std < self.min_log_std:
            raise ValueError(f"log_std must be at least min_log_std={self.min_log_std}, not {self.log_std}")


def enough_samples(config: NPGConfig, nworld: int) -> int:
    """Compute the number of samples per iteration; ``nworld`` counts the worlds of all processes."""
    return max(10_000, 16 * nworld) if config.samples is None else config.samples


def least_restarts(config: NPGConfig, nworld: int, steps: int, horizon: int) -> int:
    """Compute how many worlds must start an episode per iteration; ``nworld`` counts the worlds of all processes."""
    if horizon == 0:
        return 0
    share = config.min_restarts
    if share is None:
        share = 0.5 if horizon > _LONG_EPISODE * steps else 0.0
    return round(min(nworld, share * nworld * steps / horizon))


@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGIteration(OnPolicyIteration):
    """Statistics of one iteration of NPG.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended.
    """

    step_norm: float
    """Euclidean norm of the full step in the policy's parameters."""
    step_fraction: float
    """Fraction of the full step that was applied; less than 1 if the full step exceeded the limit of the KL
    divergence."""
    gradient_norm: float
    """Euclidean norm of the vanilla policy gradient."""
    value_error: float
    """Squared error of the value function before the fit, divided by the squared error of always predicting 0."""
    explained_variance: float
    """Fraction of the returns' variance that the value function explained before the fit."""
    outliers: int
    """Number of clipped advantages. Their limit is ten times the standard deviation of the returns."""
    skipped_updates: int
    """Number of updates that NPG skipped because they were not finite: 0, 1 or 2. Each iteration updates the policy and
    the value function."""
    time_gradient: float
    """Seconds for advantages and the vanilla gradient."""
    time_solve: float
    """Seconds for conjugate gradient and the step."""
    time_value: float
    """Seconds for the value function's fit. On two CPU threads, the fit overlaps with the step. Only ``time_solve``
    includes the overlapping time."""


class NPG(OnPolicyLearner):
    """Infinite iterator of ``NPGIteration`` that learns a policy by NPG.

    Example:
        >>> for it in NPG(env):
        ...     print(it.return_mean)

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
        FloatingPointError: The policy's step or the value function's fit was not finite in 10 consecutive iterations.
            Non-finite updates are skipped and counted in ``NPGIteration.skipped_updates``.
    """

    algorithm = "npg"
    """The name of the algorithm in a run's config.json."""
    config_type, twice = NPGConfig, True
    config: NPGConfig
    """Hyperparameters."""
    segments: bool
    """Whether iterations continue the last iteration's episodes instead of starting new ones."""

    def __init__(
        self,
        env: Env,
        policy: GaussianPolicy | None = None,
        value: ValueFunction | None = None,
        config: NPGConfig | None = None,
        *,
        seed: int = 0,
        team: Team | None = None,
    ) -> None:
        super().__init__(env, policy, value, config, seed=seed, team=team)
        config, team, device = self.config, self.team, env.obs.device
        nworld = env.nworld * team.size
        self._value_is_new = value is None
        scale = 1.0 / max(1.0 - config.gamma, 1e-3)
        self._make_networks(policy, value, scale=scale, time_orders=config.time_orders)

        # with a GPU or several processes, the host would wait for each number that it reads
        self._reads_numbers = device.type == "cpu" and team.size == 1

        # samples
        samples = enough_samples(config, nworld)
        steps = -(-samples // nworld)
        reaches_horizon = 0 < env.horizon <= steps
        self.segments = config.rollout == "segments" or (config.rollout == "auto" and not reaches_horizon)
        self._make_rollout(steps, first_only=not self.segments)
        if not self.segments and not reaches_horizon and team.leads:
            log.warning(
                "%d samples in %d worlds are only %d steps per world, so no episode reaches its horizon of %d: use "
                "fewer worlds, more samples, or rollout='segments'", samples, nworld, self.rollout.steps, env.horizon,
            )  # fmt: skip
        self._least_restarts = least_restarts(config, nworld, steps, env.horizon) if self.segments else 0
        self.noise = torch.empty(steps, nworld, env.action_space.size, device=device)

        # parts
        self.fit = ValueFit(
            self.value, self.count, env.nworld, rate=config.value_rate, epochs=config.value_epochs,
            batch=config.value_batch or max(64, self.count // 256), team=team,
        )  # fmt: skip
        self._fisher_count = max(1, round(config.fisher_fraction * self.count))
        self._dense = self.policy
        self._skipping = 0
        self.rollout.restart()
        if self.segments:
            self.rollout.stagger(self.generator, team)

    def __next__(self) -> NPGIteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer = PhaseTimer(self.env.obs.device)

        # 1. Collect samples.
        if not self.segments:
            rollout.restart()
        elif self._least_restarts:
            rollout.restart_some(self._least_restarts, self.generator, team)
        self.sample()
        timer.mark("sample")

        # 2. Update the policy's normaliser.
        obs, value_obs = rollout.obs.flatten(0, 1), rollout.obs_groups[self.value.group].flatten(0, 1)
        old_mean = self.observe(obs)

        # 3. Compute advantages with the old value function.
        advantage, target, prediction, outliers = self.advantages()

        # 4. Compute the vanilla gradient of E[log pi(a|s) A(s, a)].
        action = rollout.action.flatten(0, 1)
        weight = advantage.flatten() / self.count
        gradient = team.sum(score_gradient(self._dense, obs, action, weight))
        timer.mark("gradient")

        # 5. Compute the natural gradient x = F^-1 g, and the step x sqrt(delta / (g.x)), so that step.F.step = delta.
        fisher = self.fisher(obs)

        # 6. Fit the value function to the samples' returns; with two CPU threads, the fit runs in parallel with step 5.
        # Updating the normaliser changes the value function's predictions; the fit corrects this change.
        self.value.observe(value_obs, team)
        fit = functools.partial(self.fit, value_obs, rollout.step.flatten(), target.flatten(), self.generator)
        with beside(fit, allowed=self._reads_numbers) as fit_result:
            direction = conjugate_gradient(fisher, gradient, config.cg_iterations)
            step = direction * torch.sqrt(config.delta / (gradient @ direction + 1e-20))
            finite, fraction, kl = self.move(step, obs, old_mean)
            timer.mark("solve")
            fitted = fit_result()

        # copy all numbers to the host at once
        update = {
            "kl": kl, "step_norm": step.norm(), "step_fraction": fraction, "gradient_norm": gradient.norm(),
            "std_mean": self.policy.log_std.detach().exp().mean(),
        }  # fmt: skip
        numbers = {"finite": finite, "fitted": fitted, "outliers": outliers, **prediction}
        statistics, processes = gathered(rollout, team, update | numbers)
        statistics |= {name: processes[0][name] for name in update} | value_statistics(processes, len(obs))
        statistics["outliers"] = round(sum(process["outliers"] for process in processes))
        statistics["skipped_updates"] = self._check_updates(processes[0])
        timer.mark("value")

        # 7. Evaluate the mean policy.
        return self._finished(NPGIteration, timer, statistics, rate_of=("sample",))

    def _check_updates(self, update: Mapping[str, float]) -> int:
        parts = {"the step of the policy": update["finite"], "the fit of the value function": update["fitted"]}
        skipped = [part for part, finite in parts.items() if not finite]
        self._skipping = self._skipping + 1 if skipped else 0
        if self._skipping >= _PATIENCE:
            last, self._skipping = self.iteration + 1, 0
            raise FloatingPointError(
                f"{' and '.join(skipped)} in iteration {last} {'are' if len(skipped) > 1 else 'is'} not finite, as "
                f"in the {_PATIENCE - 1} iterations before; all these updates were skipped: make delta, value_rate, or "
                f"the rewards and observations smaller ({self.rollout.extremes()})"
            )
        return len(skipped)

    def sample(self) -> None:
        """Fill the rollout buffer with samples of the current policy."""
        with one_thread():
            self.noise.normal_(generator=self.generator)
            self._dense = dense_policy(self.policy)
            self.rollout.collect(self._dense, self.noise[:, self.own_worlds])
            self.env.update_shared(self.team.sum)

    @torch.no_grad()
    def advantages(self) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor], torch.Tensor]:
        """Compute generalised advantages and discounted returns of the rollout.

        The returns bootstrap from the value function at time limits and at the end of the rollout. Terminal states have
        the value 0 (as in mjrl, unlike Lyceum). The standard deviation of the returns becomes the value function's
        scale.

        Returns:
            Advantages and returns, each (steps, nworld); statistics of the value function's errors; and the number of
            clipped advantages. The advantages are divided by a power of two close to the value function's scale.
        """
        rollout, config, team = self.rollout, self.config, self.team
        value = self.predict(rollout.obs_groups[self.value.group], rollout.step)
        next_value = self.predict(rollout.final_obs_groups[self.value.group], rollout.step + 1.0)
        advantage, target = self._estimate(rollout.reward, value, next_value)
        prediction = prediction_sums(target, value)
        self.value.rescale(target, first=self._value_is_new and self.iteration == 0, team=team)
        # a factor on the advantages does not change the step, and division by a power of two causes no rounding
        unit = torch.exp2(torch.floor(torch.log2(self.value.scale)))
        advantage, scale = advantage / unit.float(), (self.value.scale / unit).float()
        bound = BOUND * scale
        outliers = (advantage.abs() > bound).sum()
        advantage = torch.minimum(torch.maximum(advantage, -bound), bound)
        if config.whiten:
            advantage = advantage - team.sum(advantage.sum()) / self.count
            variance = team.sum(advantage.square().sum()) / (self.count - 1)
            advantage = advantage / (variance.sqrt() + 1e-6 * scale)
        return advantage, target, prediction, outliers

    def predict(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Predict returns, (...,), and replace non-finite predictions by the mean return of the last fit."""
        value = predict(self.value, obs, step)
        return torch.where(value.isfinite(), value, self.value.shift.float())

    @torch.no_grad()
    def observe(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute the policy's mean actions, then update the normaliser of its observations.

        If an update would change the policy by more than a fifth of the desired KL divergence, only a fraction of the
        update is applied. Later iterations apply the rest. The reported KL divergence includes this change.
        """
        mean, normalizer = self._dense, self.policy.normalizer
        old_mean = mean(obs).clone()
        if isinstance(normalizer, Normalizer):
            before = normalizer.shift.clone(), normalizer.scale.clone()
            self.policy.observe(obs, self.team)
            after = normalizer.shift.clone(), normalizer.scale.clone()
            limit, part = _DRIFT * 0.5 * self.config.delta, torch.ones_like(after[0][0])
            for _ in range(_SHORTER):
                normalizer.interpolate(before, after, part)
                square = (old_mean - mean(obs)).square()
                kl = 0.5 * (square * torch.exp(-2 * self.policy.log_std)).sum(-1).mean()
                kl = self.team.sum(kl) / self.team.size
                if self._reads_numbers and kl <= limit:
                    break
                part = torch.where(kl <= limit, part, part * (limit / kl).sqrt().nan_to_num(0.1).clamp(0.01, 0.5))
            normalizer.interpolate(before, after, part)
        return old_mean

    def fisher(self, obs: torch.Tensor) -> FisherProduct:
        """Make the ``FisherProduct`` of a random subset of the samples."""
        weight = None
        if self._fisher_count < self.count:
            subset = torch.randperm(self.count, generator=self.generator, device=obs.device)[: self._fisher_count]
            if self.team.size == 1:
                obs = obs[subset]
            else:  # selection by a mask would synchronise
                places, local = self.team.locate(subset, self.env.nworld)
                obs, weight = obs[places], local.float()
        return FisherProduct(
            self._dense, obs, self.config.damping, count=self._fisher_count, weight=weight, team=self.team
        )

    @torch.no_grad()
    def move(
        self, step: torch.Tensor, obs: torch.Tensor, old_mean: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Add a step to the policy's parameters, and shorten the step if the KL divergence exceeds its limit.

        The KL divergence can exceed its limit because the Fisher information predicts it only to second order. If a
        step is still too long after four reductions, or is not finite, the policy does not change. The host does not
        wait for the device.

        Returns:
            Whether the step and the divergence are finite; the fraction of the step that was applied; and the KL
            divergence from the old to the new policy, averaged over the samples of all processes.
        """
        desired = 0.5 * self.config.delta
        limit = self.config.kl_limit * desired + 1e-6  # margin for rounding
        parameters = [p for p in self.policy.parameters() if p.requires_grad]
        old = [p.clone() for p in parameters]
        old_log_std = self.policy.log_std.clone()
        lowest = old_log_std.clamp_max(self.config.min_log_std)

        def apply(fraction: torch.Tensor) -> torch.Tensor:
            """Apply a fraction of the step, and return the KL divergence."""
            for parameter, before, part in zip(parameters, old, unflatten(step, old), strict=True):
                moved = before + fraction * part
                if parameter is self.policy.log_std:
                    moved = torch.maximum(moved, lowest)
                parameter.copy_(torch.where(fraction > 0.0, moved, before))
            kl = divergence(old_mean, old_log_std, self._dense(obs), self.policy.log_std).mean()
            return self.team.sum(kl) / self.team.size

        finite = torch.isfinite(step).all()
        fraction = finite.float()
        for _ in range(_SHORTER):
            kl = apply(fraction)
            if self._reads_numbers and kl <= limit:
                break
            factor = (desired / kl).sqrt().nan_to_num(0.1).clamp(0.01, 0.5)
            fraction = torch.where(kl <= limit, fraction, fraction * factor)
        else:
            kl = apply(fraction)
            fraction = torch.where(kl <= limit, fraction, 0.0)
            kl = apply(fraction)
        self.team.copy_leader(self.policy.parameters())
        return finite & kl.isfinite(), fraction, kl

    def settings(self) -> dict[str, Any]:
        """Return the hyperparameters and the networks' sizes for a run's config.json."""
        samples = enough_samples(self.config, self.env.nworld * self.team.size)
        return super().settings() | {"samples": samples}

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state; see ``Learner``."""
        return super().state_dict() | {"optimizer": copy.deepcopy(self.fit.optimizer.state_dict())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self.fit.load_state_dict(state["optimizer"])


def prediction_sums(returns: torch.Tensor, predicted: torch.Tensor) -> dict[str, torch.Tensor]:
    """Compute statistics of the returns and of the prediction errors, as scalar tensors.

    The statistics are the mean and the sum of squared deviations from the mean.
    """
    target, error = returns.double(), (returns - predicted).double()
    return {
        "target_mean": (target_mean := target.mean()),
        "target_square": (target - target_mean).square().sum(),
        "error_mean": (error_mean := error.mean()),
        "error_square": (error - error_mean).square().sum(),
    }


def value_statistics(sums: Sequence[Mapping[str, float]], samples: int) -> dict[str, float]:
    """Compute ``value_error`` and ``explained_variance`` from the sums of all processes.

    ``samples`` is the number of samples of each process.
    """
    sized = [{**part, "samples": samples} for part in sums]
    n, mean, square = pooled(sized, "samples", "target_mean", "target_square")
    _, error_mean, error_square = pooled(sized, "samples", "error_mean", "error_square")
    error, size = error_square + n * error_mean**2, square + n * mean**2
    return {
        "value_error": error / max(size, 1e-20 * n),
        "explained_variance": 1.0 - error_square / max(square, 1e-20 * n),
    }
