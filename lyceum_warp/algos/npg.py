"""Natural policy gradient, in the order of its mathematics.

Kakade (2002), in the form of Rajeswaran et al. (2017, "Towards Generalization and Simplicity in Continuous
Control"): generalised advantages, the vanilla gradient, conjugate gradient on the Fisher information, and a
step of a fixed length in the metric of the Fisher information.
"""

import copy
import logging
from collections.abc import Iterator
from typing import Any

import torch
import warp as wp

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.evaluation import MEAN_STATISTICS, MeanPolicyEvaluation
from lyceum_warp.algos.natural_gradient import FisherProduct, conjugate_gradient, flatten
from lyceum_warp.algos.networks import Normalizer
from lyceum_warp.algos.npg_config import NPGConfig, enough_samples
from lyceum_warp.algos.npg_statistics import (
    Iteration,
    ProcessNumbers,
    UpdateNumbers,
    ValueSums,
    finished,
    finished_metrics,
    prediction_sums,
    summary,
)
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.rollout_buffer import Rollout
from lyceum_warp.algos.timing import PhaseTimer, one_thread
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.algos.value_fit import ValueFit
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.env import Env
from lyceum_warp.kernels import returns
from lyceum_warp.validate import check_kind

log = logging.getLogger(__name__)


@document_attributes
class NPG:
    """Learns a policy; an endless iterator that yields an ``Iteration`` each time.

    Example:
        >>> for it in NPG(env):
        ...     print(it.return_mean)

    Args:
        env: The environment; do not step it between iterations.
        policy: The policy; a new one by default.
        value: The value function; a new one by default.
        config: Hyperparameters.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together, each with an environment of its share of the worlds. All of them must
            make the same calls with the same arguments; all get the same numbers.

    Raises:
        ValueError: The environment does not reset automatically, or an argument is of the wrong type.
        FloatingPointError: Raised by an iteration whose gradient is not finite; the policy is left unchanged.
    """

    policy: GaussianPolicy
    """The policy that is learned."""
    value: ValueFunction
    """The value function that is learned with it."""
    rollout: Rollout
    """The samples of the last iteration."""
    count: int
    """Samples in an iteration, those of all processes."""
    segments: bool
    """Whether an iteration continues the episodes of the last one; False if it begins new ones."""
    iteration: int
    """Number of complete iterations."""
    samples: int
    """Samples in all iterations so far."""

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
        n, nworld = env.nworld, env.nworld * team.size
        self._own = slice(team.rank * n, (team.rank + 1) * n)
        if team.size > 1 and env.first_world != self._own.start:
            raise ValueError(
                f"process {team.rank} of {team.size} with {n} worlds needs an environment with "
                f"first_world={self._own.start}, not {env.first_world}"
            )
        if not env.autoreset:
            raise ValueError("NPG needs an environment that resets automatically: make it with autoreset=True")

        # networks
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
        for module in (self.policy, self.value):
            module.to(device)
            if not any(parameter.requires_grad for parameter in module.parameters()):
                module.requires_grad_(True)  # a loaded one is frozen

        # samples, and whether an iteration begins new episodes or continues those of the last one
        samples = enough_samples(config, nworld)
        self.rollout = Rollout(env, -(-samples // nworld))
        self.count = self.rollout.steps * nworld
        whole = 0 < env.horizon <= self.rollout.steps
        self.segments = config.rollout == "segments" or (config.rollout == "auto" and not whole)
        if not self.segments and not whole and team.leads:
            log.warning(
                "%d samples of %d worlds are %d steps: no episode will reach its horizon of %d; use fewer worlds, "
                "more samples, or rollout='segments'", samples, nworld, self.rollout.steps, env.horizon,
            )  # fmt: skip
        self.noise = torch.empty(self.rollout.steps, nworld, nact, device=device)
        self._advantage = torch.empty_like(self.rollout.reward)
        self._return = torch.empty_like(self.rollout.reward)

        # parts
        self.fit = ValueFit(
            self.value, self.count, n, rate=config.value_rate, epochs=config.value_epochs,
            batch=config.value_batch or max(64, self.count // 256), team=team,
        )  # fmt: skip
        fisher_samples = torch.arange(0, self.count, min(self.count, round(1.0 / config.fisher_fraction)))
        places, own = team.locate(fisher_samples, n)
        self._fisher_count, self._fisher_places = len(fisher_samples), places[own].to(device)
        self._evaluate_mean = MeanPolicyEvaluation(env, config.mean_episodes, team)
        # a seed of its own: the same numbers should not make both the weights and the noise
        self.generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=init)))

        self.iteration = self.samples = 0
        self.rollout.restart()
        if self.segments:
            self.rollout.stagger(self.generator, team)

    def __iter__(self) -> Iterator[Iteration]:
        return self

    def __next__(self) -> Iteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer = PhaseTimer(self.env.obs.device)

        # 1. Samples of the current policy.
        if not self.segments:
            rollout.restart()
        self.sample()
        timer.mark()

        # 2. Advantages, from the value function that was not yet fitted to these samples.
        advantage, target, prediction = self.advantages()

        # 3. Vanilla gradient of E[log pi(a|s) A(s, a)].
        obs, action = rollout.obs.flatten(0, 1), rollout.action.flatten(0, 1)
        parameters = [p for p in self.policy.parameters() if p.requires_grad]
        objective = (self.policy.log_prob(obs, action) * advantage.flatten()).sum() / self.count
        gradient = team.sum(flatten(torch.autograd.grad(objective, parameters)))
        timer.mark()

        # 4. Natural gradient x = F^-1 g, and the step x sqrt(delta / (g.x)), so that step.F.step = delta.
        fisher_obs = obs if self._fisher_count == self.count else obs[self._fisher_places]
        fisher = FisherProduct(self.policy, fisher_obs, config.damping, count=self._fisher_count, team=team)
        direction = conjugate_gradient(fisher, gradient, config.cg_iterations)
        step = direction * torch.sqrt(config.delta / (gradient @ direction + 1e-20))
        finite, kl = self.move(step, obs)
        timer.mark()

        # One copy brings the numbers of all processes to the host.
        update = UpdateNumbers(
            finite=finite, kl=kl, step_norm=step.norm(), gradient_norm=gradient.norm(),
            std_mean=self.policy.log_std.detach().exp().mean(), faults=rollout.faults.sum(),
        )  # fmt: skip
        packed = ProcessNumbers(update, prediction, finished(rollout), finished_metrics(rollout)).pack()
        processes = [ProcessNumbers.unpack(numbers) for numbers in team.gather(packed[None]).tolist()]
        if not processes[0].update.finite:
            raise FloatingPointError(
                f"the policy gradient of iteration {self.iteration + 1} is not finite; the policy is unchanged. "
                f"{rollout.explain_not_finite()}"
            )

        # 5. The value function, on the returns of these samples.
        self.fit(obs, rollout.step.flatten(), target.flatten(), self.generator)
        for module in (self.policy, self.value):
            if isinstance(module.normalizer, Normalizer):
                module.normalizer.update(obs, team)
        timer.mark()

        # 6. Every few iterations, the mean policy in whole episodes.
        self.iteration += 1
        self.samples += self.count
        mean: dict[str, Any] = dict.fromkeys(MEAN_STATISTICS)
        if config.mean_every and self.iteration % config.mean_every == 0:
            mean = self._evaluate_mean(self.policy)
        timer.mark()

        time_sample, time_gradient, time_solve, time_value, time_mean = timer.seconds()
        return Iteration(
            iteration=self.iteration,
            samples=self.samples,
            **summary(processes, len(obs), self.env.task.task.metrics),
            **mean,
            time_sample=time_sample,
            time_gradient=time_gradient,
            time_solve=time_solve,
            time_value=time_value,
            time_mean=time_mean,
            samples_per_second=self.count / time_sample,
        )

    def sample(self) -> None:
        """Fill the rollout buffer with steps of the current policy under new noise."""
        with one_thread():
            self.noise.normal_(generator=self.generator)
            self.rollout.collect(self.policy, self.noise[:, self._own])

    @torch.no_grad()
    def advantages(self) -> tuple[torch.Tensor, torch.Tensor, ValueSums]:
        """Generalised advantages and discounted returns of the rollout.

        At a time limit and at the end of the rollout, the value function's prediction stands for the rest of the
        episode. A state in which the episode terminated is worth 0 (mjrl; Lyceum bootstraps there, too).

        Returns:
            Advantages, (steps, nworld); returns, (steps, nworld); and how well the value function predicted them.
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
        prediction = prediction_sums(target, value)
        if config.whiten:
            advantage = advantage - team.sum(advantage.sum()) / self.count
            variance = team.sum(advantage.square().sum()) / (self.count - 1)
            advantage = advantage / (variance.sqrt() + 1e-6)
        return advantage, target, prediction

    @torch.no_grad()
    def move(self, step: torch.Tensor, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Add a step to the policy's parameters, unless it is not finite.

        Args:
            step: The step, (parameters,).
            obs: Observations, (samples, nobs).

        Returns:
            Whether the step is finite; and the KL divergence from the old policy to the new one, averaged over
            ``obs``.
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
        self.team.copy_leader(self.policy.parameters())
        log_std = self.policy.log_std
        square = (old_mean - self.policy(obs)).square() + torch.exp(2 * old_log_std)
        return finite, (log_std - old_log_std + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1).mean()

    def state_dict(self) -> dict[str, Any]:
        """The state on which the next iteration depends, with the worlds of all processes.

        All processes must call it. Any number of processes can continue from it.
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
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: The state has another number of worlds, or does not fit for another reason.
        """
        nworld = self.env.nworld * self.team.size
        if len(state["env"]) != nworld:
            raise ValueError(f"the state has {len(state['env'])} worlds, but the environment has {nworld}")
        self.policy.load_state_dict(state["policy"])
        self.value.load_state_dict(state["value"])
        self.fit.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        self.env.set_state(state["env"][self._own].to(self.env.obs.device))
        self.rollout.running_return.copy_(state["returns"][self._own])
        self.iteration = state["iteration"]
        self.samples = state["samples"]
