"""Natural policy gradient, in the order of its mathematics.

Kakade (2002), in the form of Rajeswaran et al. (2017, "Towards Generalization and Simplicity in Continuous
Control"): generalised advantages, the vanilla gradient, conjugate gradient on the Fisher information, and a
step of a fixed length in the metric of the Fisher information.
"""

import contextlib
import copy
import dataclasses
import logging
import math
import time
from collections.abc import Iterator
from typing import Any, Literal

import torch
import warp as wp

from lyceum_warp.algos.policy import GaussianPolicy, Normalizer
from lyceum_warp.algos.rollout import Episodes, Rollout, evaluate, finished
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.env import Env
from lyceum_warp.kernels import returns

log = logging.getLogger(__name__)

MEAN_SEED = 2**31 - 1
"""Seed of the initial states from which the mean policy is evaluated."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGConfig:
    """Hyperparameters; the defaults are the paper's where it gives them."""

    samples: int = 10_000
    """Samples in an iteration; rounded up to whole steps of all worlds."""
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
    value_batch: int = 64
    """Samples in a mini-batch of the same."""
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
    ) -> None:
        self.env = env
        self.config = config = config or NPGConfig()
        _check(config)
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
        self.policy.to(device)
        self.value.to(device)
        self.optimizer = torch.optim.Adam(self.value.parameters(), lr=config.value_rate, fused=True)
        self.rollout = Rollout(env, -(-config.samples // env.nworld))
        whole = 0 < env.horizon <= self.rollout.steps
        self.segments = config.rollout == "segments" or (config.rollout == "auto" and not whole)
        if not self.segments and not whole:
            log.warning(
                "%d samples of %d worlds are %d steps: no episode will reach its horizon of %d; take fewer worlds, "
                "more samples, or rollout='segments'", config.samples, env.nworld, self.rollout.steps, env.horizon,
            )  # fmt: skip
        self.noise = torch.empty_like(self.rollout.action)
        # a seed of its own: the same numbers should not make both the weights and the noise
        self.generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=init)))
        self.iteration = 0
        self.samples = 0
        self._advantage = torch.empty_like(self.rollout.reward)
        self._return = torch.empty_like(self.rollout.reward)
        self._mean_env: Env | None = None
        self.rollout.restart()
        if self.segments:
            self.rollout.stagger(self.generator)

    def __iter__(self) -> Iterator[Iteration]:
        return self

    def __next__(self) -> Iteration:
        config, rollout = self.config, self.rollout
        faults_before = sum(self.env.fault_counts.values())
        clock = _Clock(self.env.obs.device)

        # 1. Samples of the current policy.
        if not self.segments:
            rollout.restart()
        self.sample()
        time_sample = clock.lap()

        # 2. Advantages, from the value function as it was while the samples were drawn.
        advantage, target, statistics = self.advantages()

        # 3. Vanilla gradient of E[log pi(a|s) A(s, a)].
        obs, action = rollout.obs.flatten(0, 1), rollout.action.flatten(0, 1)
        parameters = [p for p in self.policy.parameters() if p.requires_grad]
        objective = (self.policy.log_prob(obs, action) * advantage.flatten()).mean()
        gradient = _flat(torch.autograd.grad(objective, parameters))
        time_gradient = clock.lap()

        # 4. Natural gradient x = F^-1 g, and the step x sqrt(delta / (g.x)), so that step.F.step = delta.
        fisher = FisherProduct(self.policy, _thinned(obs, config.fisher_fraction), config.damping)
        direction = conjugate_gradient(fisher, gradient, config.cg_iterations)
        step = direction * torch.sqrt(config.delta / (gradient @ direction + 1e-20))
        if not torch.isfinite(step).all():
            raise FloatingPointError(
                f"the policy gradient of iteration {self.iteration + 1} is not finite; the policy was left as it "
                "was. Check the task's rewards and observations, or make the step (delta) smaller"
            )
        kl = self.move(step, obs)
        time_solve = clock.lap()

        # 5. The value function, on the returns of these samples.
        self.fit_value(obs, rollout.step.flatten(), target.flatten())
        for module in (self.policy, self.value):
            if isinstance(module.normalizer, Normalizer):
                module.normalizer.update(obs)
        time_value = clock.lap()

        # One copy brings all numbers to the host.
        spread = self.policy.log_std.detach().exp().mean()
        numbers = torch.stack([kl, step.norm(), gradient.norm(), spread, *statistics]).tolist()
        self.iteration += 1
        self.samples += obs.shape[0]
        episodes = finished(rollout)
        mean = self._evaluate_mean()
        return Iteration(
            iteration=self.iteration,
            samples=self.samples,
            **_summary(episodes),
            **mean,
            kl=numbers[0],
            step_norm=numbers[1],
            gradient_norm=numbers[2],
            std_mean=numbers[3],
            value_error=numbers[4],
            explained_variance=numbers[5],
            faults=sum(self.env.fault_counts.values()) - faults_before,
            time_sample=time_sample,
            time_gradient=time_gradient,
            time_solve=time_solve,
            time_value=time_value,
            time_mean=clock.lap(),
            samples_per_second=obs.shape[0] / time_sample,
        )

    def sample(self) -> None:
        """Fill the record with steps of the current policy under fresh noise."""
        with _one_thread():
            self.noise.normal_(generator=self.generator)
            self.rollout.collect(self.policy, self.noise)

    @torch.no_grad()
    def advantages(self) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
        """Generalised advantages and discounted returns, (steps, nworld), and how well the values fitted them.

        A state that a time limit, or the end of the record, cut off is worth what the value function says; a
        state in which the episode terminated is worth nothing (mjrl; Lyceum bootstraps there, too).
        """
        rollout, config = self.rollout, self.config
        value = self.value(rollout.obs, rollout.step)
        next_value = self.value(rollout.final_obs, rollout.step + 1.0)
        arrays = [rollout.reward, value, next_value, rollout.terminated, rollout.done]
        inputs = [wp.from_torch(array) for array in arrays]
        outputs = [wp.from_torch(self._advantage), wp.from_torch(self._return)]
        args = [*inputs, config.gamma, config.lam, *outputs]
        wp.launch(returns.advantages, self.env.nworld, args, device=self.env.device)
        advantage, target = self._advantage, self._return
        error = (target - value).square().mean() / target.square().mean().clamp_min(1e-20)
        explained = 1.0 - (target - value).var() / target.var().clamp_min(1e-20)
        if config.whiten:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        return advantage, target, [error, explained]

    @torch.no_grad()
    def move(self, step: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """Add a step to the policy's parameters; returns the mean KL divergence from the old to the new."""
        old_mean, old_log_std = self.policy(obs), self.policy.log_std.clone()
        start = 0
        for parameter in self.policy.parameters():
            if parameter.requires_grad:
                parameter.add_(step[start : start + parameter.numel()].view_as(parameter))
                start += parameter.numel()
        self.policy.log_std.clamp_(min=self.config.min_log_std)
        log_std = self.policy.log_std
        square = (old_mean - self.policy(obs)).square() + torch.exp(2 * old_log_std)
        return (log_std - old_log_std + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1).mean()

    def fit_value(self, obs: torch.Tensor, step: torch.Tensor, target: torch.Tensor) -> None:
        """Mini-batch Adam on the squared error of the value function, in random order."""
        config = self.config
        with torch.no_grad():
            features = self.value.features(obs, step)
            target = (target / self.value.scale).unsqueeze(-1)
        with _one_thread():
            for _ in range(config.value_epochs):
                order = torch.randperm(len(features), generator=self.generator, device=features.device)
                for batch in order.split(config.value_batch):
                    self.optimizer.zero_grad(set_to_none=False)
                    torch.nn.functional.mse_loss(self.value.network(features[batch]), target[batch]).backward()
                    self.optimizer.step()

    def _evaluate_mean(self) -> dict[str, Any]:
        config = self.config
        names = ("mean_return", "mean_length", "mean_terminal_reward", "mean_eval", "mean_success")
        if not config.mean_every or self.iteration % config.mean_every:
            return dict.fromkeys(names)
        if self._mean_env is None:
            self._mean_env = self.env.replicate(nworld=config.mean_episodes)
        # the same initial states each time, and none of those that are trained on: what changes is the policy
        self._mean_env.follow(self.env)
        episodes = evaluate(self._mean_env, self.policy, config.mean_episodes, seed=MEAN_SEED)
        parts = (episodes.returns, episodes.lengths, episodes.rewards, episodes.evals, episodes.success)
        return {name: part.mean().item() for name, part in zip(names, parts, strict=True)}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        state = {
            "policy": self.policy.state_dict(),
            "value": self.value.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "env": self.env.get_state(),
            "returns": self.rollout.running_return.clone(),
            "iteration": self.iteration,
            "samples": self.samples,
        }
        return copy.deepcopy(state)  # a module's own state_dict shares memory with its parameters

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly where ``state_dict`` was taken."""
        self.policy.load_state_dict(state["policy"])
        self.value.load_state_dict(state["value"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        self.env.set_state(state["env"].to(self.env.obs.device))
        self.rollout.running_return.copy_(state["returns"])
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
    """

    def __init__(self, policy: GaussianPolicy, obs: torch.Tensor, damping: float) -> None:
        self.parameters = [p for p in policy.parameters() if p.requires_grad]
        self.log_std_at = next((i for i, p in enumerate(self.parameters) if p is policy.log_std), None)
        self.network = [p for p in self.parameters if p is not policy.log_std]
        self.precision = torch.exp(-2 * policy.log_std.detach()) / len(obs)
        self.damping = damping
        self.mean = policy(obs)
        self.probe = torch.zeros_like(self.mean, requires_grad=True)
        self.pulled = torch.autograd.grad(self.mean, self.network, self.probe, create_graph=True)

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        """(F + damping) vector, both (parameters,)."""
        parts = [
            part.view_as(p)
            for part, p in zip(vector.split([p.numel() for p in self.parameters]), self.parameters, strict=True)
        ]
        products = []
        if self.log_std_at is not None:
            products = [2.0 * parts.pop(self.log_std_at)]
        (pushed,) = torch.autograd.grad(self.pulled, self.probe, parts, retain_graph=True)
        pulled = list(torch.autograd.grad(self.mean, self.network, pushed * self.precision, retain_graph=True))
        if self.log_std_at is not None:
            pulled.insert(self.log_std_at, products[0])
        return _flat(pulled) + self.damping * vector


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
        alpha = torch.where(curvature > 0, square / curvature, 0.0)
        x += alpha * direction
        residual -= alpha * image
        previous, square = square, residual @ residual
        direction = residual + torch.where(previous > 0, square / previous, 0.0) * direction
    return x


def _flat(tensors: Any) -> torch.Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _thinned(obs: torch.Tensor, fraction: float) -> torch.Tensor:
    """Evenly spread samples."""
    return obs if fraction >= 1.0 else obs[:: max(1, round(1.0 / fraction))]


def _summary(episodes: Episodes) -> dict[str, float]:
    nan = math.nan
    some = len(episodes.returns) > 0
    return {
        "return_mean": episodes.returns.mean().item() if some else nan,
        "return_std": episodes.returns.std(correction=0).item() if some else nan,
        "return_min": episodes.returns.min().item() if some else nan,
        "return_max": episodes.returns.max().item() if some else nan,
        "length_mean": episodes.lengths.mean().item() if some else nan,
        "terminal_reward": episodes.rewards.mean().item() if some else nan,
        "eval_mean": episodes.evals.mean().item() if some else nan,
        "success": episodes.success.mean().item() if some else nan,
    }


def _check(config: NPGConfig) -> None:
    limits = {
        "samples": (1, None), "gamma": (0, 1), "lam": (0, 1), "delta": (0, None), "cg_iterations": (1, None),
        "damping": (0, None), "fisher_fraction": (0, 1), "value_epochs": (0, None), "value_batch": (1, None),
        "value_rate": (0, None), "time_orders": (0, None), "mean_every": (0, None), "mean_episodes": (1, None),
    }  # fmt: skip
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        if not (value >= low and (high is None or value <= high)):
            raise ValueError(f"{name} has to be {f'from {low} to {high}' if high else f'at least {low}'}, not {value}")


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one CPU thread: operations on a step or a mini-batch are too small to share out.

    On a busy machine torch's threads would wait for each other much longer than they compute.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _Clock:
    """Seconds between calls of ``lap``, work on the device included."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.last = time.perf_counter()

    def lap(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        seconds, self.last = now - self.last, now
        return seconds
