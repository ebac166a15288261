"""Natural policy gradient, in the order of its mathematics.

Kakade (2002), in the form of Rajeswaran et al. (2017, "Towards Generalization and Simplicity in Continuous
Control"): generalised advantages, the vanilla gradient, conjugate gradient on the Fisher information, and a
step of a fixed length in the metric of the Fisher information.
"""

import copy
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any, Literal

import torch
import warp as wp

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.policy import GaussianPolicy, Normalizer
from lyceum_warp.algos.rollout_buffer import Rollout, evaluate, finished, moved, pooled, summary
from lyceum_warp.algos.timing import Clock, one_thread
from lyceum_warp.algos.value import ValueFit, ValueFunction
from lyceum_warp.env import Env
from lyceum_warp.kernels import returns
from lyceum_warp.validate import check_kind

log = logging.getLogger(__name__)

MEAN_SEED = 2**31 - 1
"""Seed of the initial states from which the mean policy is evaluated."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGConfig:
    """Hyperparameters; the defaults are the paper's where it gives them."""

    samples: int | None = None
    """Samples in an iteration, rounded up to whole steps of all worlds; by default the paper's 10,000, or 16 steps of
    every world where those are more."""
    rollout: Literal["auto", "episodes", "segments"] = "auto"
    """"episodes" begins new episodes in every iteration, as in the paper; "segments" goes on with those of the
    last iteration, for many worlds and few steps of each; "auto" takes episodes where whole ones fit, that is
    where samples / worlds >= horizon."""
    gamma: float = 0.995
    """Discount."""
    lam: float = 0.97
    """Decay of the generalised advantage estimate."""
    delta: float = 0.1
    """Squared length of a step in the Fisher metric: twice the KL divergence between old and new policy."""
    whiten: bool = True
    """Whether advantages are brought to mean 0 and standard deviation 1 (as mjrl, unlike Lyceum)."""
    cg_iterations: int = 10
    """Iterations of conjugate gradient."""
    damping: float = 1e-4
    """Added to the diagonal of the Fisher information (as mjrl; Lyceum has none)."""
    fisher_fraction: float = 1.0
    """Share of the samples that the Fisher information is averaged over."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviations."""
    min_log_std: float = -3.0
    """Lower limit of the same (as mjrl; Lyceum has none)."""
    value_hidden: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers."""
    value_epochs: int = 2
    """Passes over the samples when the value function is fitted."""
    value_batch: int | None = None
    """Samples in a mini-batch of the same; by default a 256th of all, but at least the paper's 64, so that more
    samples cost no more steps."""
    value_rate: float = 1e-3
    """Learning rate of the same (Adam)."""
    time_orders: int = 0
    """Highest power of the value function's time feature; 0 for none."""
    normalize: bool = False
    """Whether policy and value function see observations normalised by their running mean and variance."""
    mean_every: int = 10
    """Iterations between two evaluations of the mean policy; 0 for never."""
    mean_episodes: int = 16
    """Episodes in such an evaluation."""


def enough_samples(config: NPGConfig, nworld: int) -> int:
    """Samples in an iteration of so many worlds, those of all processes."""
    return max(10_000, 16 * nworld) if config.samples is None else config.samples


@dataclasses.dataclass(frozen=True, kw_only=True)
class Iteration:
    """What one iteration did. Numbers about episodes cover those that ended in it; nan where none did."""

    iteration: int
    """Counted from 1."""
    samples: int
    """Samples since the beginning."""
    return_mean: float
    """Mean return of the stochastic policy."""
    return_std: float
    return_min: float
    return_max: float
    length_mean: float
    """Mean steps of an episode."""
    terminal_reward: float
    """Mean reward of an episode's last step."""
    eval_mean: float
    """Mean evaluation metric at an episode's end."""
    success: float
    """Share of the episodes that ended with the goal met."""
    mean_return: float | None
    """Mean return of the mean policy; None in iterations without its evaluation."""
    mean_length: float | None
    mean_terminal_reward: float | None
    mean_eval: float | None
    mean_success: float | None
    kl: float
    """KL divergence from the old to the new policy, averaged over the samples."""
    step_norm: float
    """Euclidean length of the step in the policy's parameters."""
    gradient_norm: float
    """Euclidean length of the vanilla policy gradient."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""
    value_error: float
    """Squared error of the value function before the fit, relative to that of predicting 0."""
    explained_variance: float
    """Share of the returns' variance that the value function explained before the fit."""
    faults: int
    """Faults of worlds in this iteration."""
    time_sample: float
    """Seconds of sampling."""
    time_gradient: float
    """Seconds for advantages and the vanilla gradient."""
    time_solve: float
    """Seconds of conjugate gradient and of the step."""
    time_value: float
    """Seconds of fitting the value function."""
    time_mean: float
    """Seconds of evaluating the mean policy."""
    samples_per_second: float
    """Samples by seconds of sampling."""


class NPG:
    """Learns a policy; an endless iterator that yields an ``Iteration`` each time.

    Example:
        >>> for it in NPG(env):
        ...     print(it.return_mean)

    Args:
        env: The environment; nobody else should step it meanwhile.
        policy: The policy; a new one by default.
        value: The value function; a new one by default.
        config: Hyperparameters.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together, each with an environment of its share of the worlds; every one
            of them makes the same calls of the same arguments, and gets the same numbers.

    Raises:
        FloatingPointError: Raised by an iteration whose gradient is not finite; the policy stays as it was.
    """

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
        check_kind("env of NPG", env, Env, "as lw.make(...) makes it")
        check_kind("config of NPG", config, NPGConfig | None, "as lw.NPGConfig(samples=10000)")
        self.env = env
        self.team = team = team or Team()
        self.config = config = config or NPGConfig()
        _check(config)
        n, nworld = env.nworld, env.nworld * team.size
        self._own = slice(team.rank * n, (team.rank + 1) * n)
        if team.size > 1 and env.first_world != self._own.start:
            raise ValueError(
                f"process {team.rank} of {team.size} with {n} worlds needs an environment with "
                f"first_world={self._own.start}, not {env.first_world}"
            )
        if not env.autoreset:
            raise ValueError("NPG needs an environment that resets by itself: make it with autoreset=True")
        device = env.obs.device
        nobs, nact = env.obs_space.size, env.action_space.size
        init = torch.Generator().manual_seed(seed)
        options: dict[str, Any] = dict(normalize=config.normalize, generator=init)
        self.policy = policy or GaussianPolicy(nobs, nact, config.hidden, log_std=config.log_std, **options)
        scale = 1.0 / max(1.0 - config.gamma, 1e-3)
        self.value = value or ValueFunction(
            nobs, config.value_hidden, scale=scale, time_orders=config.time_orders, **options
        )
        self.value.discount = config.gamma
        self.policy.to(device)
        self.value.to(device)
        samples = enough_samples(config, nworld)
        self.rollout = Rollout(env, -(-samples // nworld))
        self.count = self.rollout.steps * nworld
        self.fit = ValueFit(
            self.value, self.count, n, rate=config.value_rate, epochs=config.value_epochs,
            batch=config.value_batch or max(64, self.count // 256), team=team,
        )  # fmt: skip
        whole = 0 < env.horizon <= self.rollout.steps
        self.segments = config.rollout == "segments" or (config.rollout == "auto" and not whole)
        if not self.segments and not whole and team.leads:
            log.warning(
                "%d samples of %d worlds are %d steps: no episode will reach its horizon of %d; take fewer worlds, "
                "more samples, or rollout='segments'", samples, nworld, self.rollout.steps, env.horizon,
            )  # fmt: skip
        self.noise = torch.empty(self.rollout.steps, nworld, nact, device=device)
        places = torch.arange(0, self.count, max(1, round(1.0 / max(config.fisher_fraction, 1e-9))))
        rows, own = team.rows(places, n)
        self._fisher_count, self._fisher_rows = len(places), rows[own].to(device)
        # a seed of its own: the same numbers should not make both the weights and the noise
        self.generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=init)))
        self.iteration = self.samples = 0
        self._advantage = torch.empty_like(self.rollout.reward)
        self._return = torch.empty_like(self.rollout.reward)
        self._mean_env: Env | None = None
        self.rollout.restart()
        if self.segments:
            self.rollout.stagger(self.generator, team)

    def __iter__(self) -> Iterator[Iteration]:
        return self

    def __next__(self) -> Iteration:
        config, rollout, team = self.config, self.rollout, self.team
        clock = Clock(self.env.obs.device)

        # 1. Samples of the current policy.
        if not self.segments:
            rollout.restart()
        self.sample()
        clock.mark()

        # 2. Advantages, from the value function as it was while the samples were drawn.
        advantage, target, fitted = self.advantages()

        # 3. Vanilla gradient of E[log pi(a|s) A(s, a)].
        obs, action = rollout.obs.flatten(0, 1), rollout.action.flatten(0, 1)
        parameters = [p for p in self.policy.parameters() if p.requires_grad]
        objective = (self.policy.log_prob(obs, action) * advantage.flatten()).sum() / self.count
        gradient = team.sum(_flat(torch.autograd.grad(objective, parameters)))
        clock.mark()

        # 4. Natural gradient x = F^-1 g, and the step x sqrt(delta / (g.x)), so that step.F.step = delta.
        some = obs if self._fisher_count == self.count else obs[self._fisher_rows]
        fisher = FisherProduct(self.policy, some, config.damping, count=self._fisher_count, team=team)
        direction = conjugate_gradient(fisher, gradient, config.cg_iterations)
        step = direction * torch.sqrt(config.delta / (gradient @ direction + 1e-20))
        finite, kl = self.move(step, obs)
        clock.mark()

        # One copy brings all numbers of this iteration to the host, those of every process.
        spread = self.policy.log_std.detach().exp().mean()
        own = [finite, kl, step.norm(), gradient.norm(), spread, *fitted, rollout.faults.sum()]
        rows = team.gather(torch.cat([torch.stack([x.double() for x in own]), finished(rollout)])[None]).tolist()
        if not rows[0][0]:
            raise FloatingPointError(
                f"the policy gradient of iteration {self.iteration + 1} is not finite; the policy was left as it was. "
                f"{rollout.trouble()}"
            )

        # 5. The value function, on the returns of these samples.
        self.fit(obs, rollout.step.flatten(), target.flatten(), self.generator)
        for module in (self.policy, self.value):
            if isinstance(module.normalizer, Normalizer):
                module.normalizer.update(obs, team)
        clock.mark()

        self.iteration += 1
        self.samples += self.count
        mean = self._evaluate_mean()
        clock.mark()
        time_sample, time_gradient, time_solve, time_value, time_mean = clock.seconds()
        _, _, step_norm, gradient_norm, std_mean = rows[0][:5]
        return Iteration(
            iteration=self.iteration,
            samples=self.samples,
            **summary([row[10:] for row in rows]),
            **mean,
            kl=sum(row[1] for row in rows) / len(rows),
            step_norm=step_norm,
            gradient_norm=gradient_norm,
            std_mean=std_mean,
            **_fit_quality(obs.shape[0], [row[5:9] for row in rows]),
            faults=round(sum(row[9] for row in rows)),
            time_sample=time_sample,
            time_gradient=time_gradient,
            time_solve=time_solve,
            time_value=time_value,
            time_mean=time_mean,
            samples_per_second=self.count / time_sample,
        )

    def sample(self) -> None:
        """Fill the record with steps of the current policy under fresh noise."""
        with one_thread():
            self.noise.normal_(generator=self.generator)
            self.rollout.collect(self.policy, self.noise[:, self._own])

    @torch.no_grad()
    def advantages(self) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
        """Generalised advantages and discounted returns, (steps, nworld), and how well the values fitted them.

        A state that a time limit, or the end of the record, cut off is worth what the value function says; a
        state in which the episode terminated is worth nothing (mjrl; Lyceum bootstraps there, too). The fit is
        told by mean and summed squared deviation of the returns, and of what the values missed of them.
        """
        rollout, config, team = self.rollout, self.config, self.team
        value = self.value(rollout.obs, rollout.step)
        next_value = self.value(rollout.final_obs, rollout.step + 1.0)
        arrays = [rollout.reward, value, next_value, rollout.terminated, rollout.done]
        inputs = [wp.from_torch(array) for array in arrays]
        outputs = [wp.from_torch(self._advantage), wp.from_torch(self._return)]
        args = [*inputs, config.gamma, config.lam, *outputs]
        wp.launch(returns.advantages, self.env.nworld, args, device=self.env.device)
        advantage, target = self._advantage, self._return
        fitted = []
        for part in (target.double(), (target - value).double()):
            fitted += [part.mean(), (part - part.mean()).square().sum()]
        if config.whiten:
            advantage = advantage - team.sum(advantage.sum()) / self.count
            variance = team.sum(advantage.square().sum()) / (self.count - 1)
            advantage = advantage / (variance.sqrt() + 1e-6)
        return advantage, target, fitted

    @torch.no_grad()
    def move(self, step: torch.Tensor, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Add a step to the policy's parameters, unless it is not finite.

        Returns:
            Whether it is finite, and the KL divergence from the old policy to the new one, averaged over ``obs``.
        """
        old_mean, old_log_std = self.policy(obs), self.policy.log_std.clone()
        finite = torch.isfinite(step).all()
        start = 0
        for parameter in self.policy.parameters():
            if parameter.requires_grad:
                moved = parameter + step[start : start + parameter.numel()].view_as(parameter)
                if parameter is self.policy.log_std:
                    moved.clamp_(min=self.config.min_log_std)
                parameter.copy_(torch.where(finite, moved, parameter))
                start += parameter.numel()
        self.team.follow(self.policy.parameters())
        log_std = self.policy.log_std
        square = (old_mean - self.policy(obs)).square() + torch.exp(2 * old_log_std)
        return finite, (log_std - old_log_std + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1).mean()

    def _evaluate_mean(self) -> dict[str, Any]:
        config = self.config
        names = ("mean_return", "mean_length", "mean_terminal_reward", "mean_eval", "mean_success")
        if not config.mean_every or self.iteration % config.mean_every:
            return dict.fromkeys(names)
        means = torch.zeros(len(names), dtype=torch.float64, device=self.env.obs.device)
        if self.team.leads:
            if self._mean_env is None:
                self._mean_env = self.env.replicate_few(config.mean_episodes)
            # the same initial states each time, and none of those that are trained on: what changes is the policy
            self._mean_env.follow(self.env)
            policy = moved(self.policy, self._mean_env)
            episodes = evaluate(self._mean_env, policy, config.mean_episodes, seed=MEAN_SEED)
            parts = (episodes.returns, episodes.lengths, episodes.rewards, episodes.evals, episodes.success)
            means.copy_(torch.stack([part.mean() for part in parts]))
        self.team.follow([means])
        return dict(zip(names, means.tolist(), strict=True))

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iteration depends on, all processes' worlds included.

        With several processes every one has to call it. Any number of them can go on from it.
        """
        state = {
            "policy": self.policy.state_dict(),
            "value": self.value.state_dict(),
            "optimizer": self.fit.state_dict(),
            "generator": self.generator.get_state(),
            "env": self.team.gather(self.env.get_state()),
            "returns": self.team.gather(self.rollout.running_return),
            "iteration": self.iteration,
            "samples": self.samples,
        }
        return copy.deepcopy(state)  # a module's own state_dict shares memory with its parameters

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where ``state_dict`` was taken.

        Raises:
            ValueError: It was taken with another number of worlds, or does not fit otherwise.
        """
        nworld = self.env.nworld * self.team.size
        if len(state["env"]) != nworld:
            raise ValueError(f"the state is one of {len(state['env'])} worlds, not of {nworld}")
        self.policy.load_state_dict(state["policy"])
        self.value.load_state_dict(state["value"])
        self.fit.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        self.env.set_state(state["env"][self._own].to(self.env.obs.device))
        self.rollout.running_return.copy_(state["returns"][self._own])
        self.iteration = state["iteration"]
        self.samples = state["samples"]


class FisherProduct:
    """Products with the Fisher information of a Gaussian policy, averaged over observations.

    For N(mean(s; theta), diag(sigma^2)) it is E[J^T diag(1 / sigma^2) J] for the parameters of the mean with
    J = d mean / d theta, and 2 for each log sigma. J v is the derivative of the linear map u -> J^T u, so both
    factors are backward passes through graphs that are built once.

    Args:
        policy: The policy.
        obs: Observations, (samples, nobs).
        damping: Added to the diagonal.
        count: Number of observations of all processes, if there are several.
        team: These processes.
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        obs: torch.Tensor,
        damping: float,
        *,
        count: int | None = None,
        team: Team | None = None,
    ) -> None:
        self.parameters = [p for p in policy.parameters() if p.requires_grad]
        self.log_std_at = next((i for i, p in enumerate(self.parameters) if p is policy.log_std), None)
        self.network = [p for p in self.parameters if p is not policy.log_std]
        self.precision = torch.exp(-2 * policy.log_std.detach()) / (count or len(obs))
        self.damping, self.team = damping, team or Team()
        self.mean = policy(obs)
        self.probe = torch.zeros_like(self.mean, requires_grad=True)
        self.pulled = torch.autograd.grad(self.mean, self.network, self.probe, create_graph=True)

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        """(F + damping) vector, both (parameters,)."""
        parts = [
            part.view_as(p)
            for part, p in zip(vector.split([p.numel() for p in self.parameters]), self.parameters, strict=True)
        ]
        spread = vector if self.log_std_at is None else parts.pop(self.log_std_at)
        (pushed,) = torch.autograd.grad(self.pulled, self.probe, parts, retain_graph=True)
        pulled = list(torch.autograd.grad(self.mean, self.network, pushed * self.precision, retain_graph=True))
        if self.log_std_at is not None:  # no sum over samples: each process brings an equal part
            pulled.insert(self.log_std_at, 2.0 / self.team.size * spread)
        return self.team.sum(_flat(pulled)) + self.damping * vector


def conjugate_gradient(product: Any, target: torch.Tensor, iterations: int) -> torch.Tensor:
    """Solve product(x) = target for a symmetric positive definite product, from x = 0.

    A fixed number of iterations and no look at the numbers, so that nothing waits for the device; once the
    residual vanishes the steps are zero.
    """
    x = torch.zeros_like(target)
    residual = target.clone()
    direction = target.clone()
    square = residual @ residual
    for _ in range(iterations):
        image = product(direction)
        curvature = direction @ image
        alpha = (square / curvature).masked_fill(~(curvature > 0), 0.0)
        x += alpha * direction
        residual -= alpha * image
        previous, square = square, residual @ residual
        direction = residual + (square / previous).masked_fill(~(previous > 0), 0.0) * direction
    return x


def _flat(tensors: Any) -> torch.Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _fit_quality(n: int, parts: list[list[float]]) -> dict[str, float]:
    """How well values fitted returns: each process's mean and summed squared deviation of returns and of errors."""
    count, mean, square = pooled([(n, part[0], part[1]) for part in parts])
    _, error_mean, error_square = pooled([(n, part[2], part[3]) for part in parts])
    error, size = error_square + count * error_mean**2, square + count * mean**2
    return {
        "value_error": error / max(size, 1e-20 * count),
        "explained_variance": 1.0 - error_square / max(square, 1e-20 * count),
    }


def _check(config: NPGConfig) -> None:
    limits = {
        "samples": (1, None), "gamma": (0, 1), "lam": (0, 1), "delta": (0, None), "cg_iterations": (1, None),
        "damping": (0, None), "fisher_fraction": (0, 1), "value_epochs": (0, None), "value_batch": (1, None),
        "value_rate": (0, None), "time_orders": (0, None), "mean_every": (0, None), "mean_episodes": (1, None),
    }  # fmt: skip
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        if value is not None and not (value >= low and (high is None or value <= high)):
            raise ValueError(f"{name} has to be {f'from {low} to {high}' if high else f'at least {low}'}, not {value}")
