"""rsl_rl's PPO as an algorithm of ``lw.train``: iterations, statistics, and a state from which it continues exactly."""

import collections
import contextlib
import copy
import dataclasses
import io
import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from lyceum_warp.adapters.rsl_rl_config import RslRlConfig
from lyceum_warp.adapters.rsl_rl_env import RslRlVecEnv
from lyceum_warp.adapters.rsl_rl_networks import (
    ENDLESS,
    begin_with,
    check_networks,
    copy_policy,
    copy_value,
    make_writable,
)
from lyceum_warp.adapters.rsl_rl_normalizer import freeze_normalizers, take_in
from lyceum_warp.adapters.rsl_rl_random import OwnRandomNumbers
from lyceum_warp.adapters.rsl_rl_release import check_rsl_rl
from lyceum_warp.adapters.rsl_rl_sampling import BatchedSampling
from lyceum_warp.adapters.rsl_rl_statistics import RECENT, RslRlIteration
from lyceum_warp.adapters.rsl_rl_update import CapturedUpdate
from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.evaluation import MEAN_STATISTICS, MeanPolicyEvaluation
from lyceum_warp.algos.learner import fitted_config
from lyceum_warp.algos.npg_statistics import EpisodeSums, episode_statistics, finished, finished_metrics
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.rollout_buffer import Rollout
from lyceum_warp.algos.timing import PhaseTimer, one_thread
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.env import Env
from lyceum_warp.validate import check_kind, whole_number

check_rsl_rl()  # its error says more than that of the imports below

from rsl_rl.utils import resolve_callable  # noqa: E402


@document_attributes
class RslRlLearner:
    """Learns a policy by rsl_rl's PPO; an endless iterator that yields an ``RslRlIteration`` each time.

    ``lw.train`` takes it like ``NPG``. The policy and the value function are copies of rsl_rl's networks, which need no
    rsl_rl. It draws random numbers of its own: torch's own generators are left as they are.

    Example:
        >>> lw.train(RslRlLearner(lw.make("hopper", nworld=64)), "runs/mine", iterations=300)

    Args:
        env: The environment; do not step it between iterations.
        policy: A policy to begin with, of a run of rsl-rl; a new one by default.
        value: The value function to begin with.
        config: Hyperparameters. Those that describe the networks are replaced by those of given networks.
        seed: Seed of new networks and of the noise.

    Raises:
        ValueError: The environment does not reset automatically, or an argument does not fit.
        FloatingPointError: A loss, or a parameter of a network, is not finite after an iteration.
    """

    algorithm = "rsl-rl"
    """The name of the algorithm in a run's config.json."""
    env: Env
    """The environment."""
    team: Team
    """This process alone."""
    policy: GaussianPolicy
    """The policy after the last iteration."""
    value: ValueFunction
    """The value function after the last iteration."""
    ppo: Any
    """rsl_rl's PPO."""
    rollout: Rollout
    """The samples of the last iteration."""
    seed: int
    """Seed of new networks and of the noise."""
    count: int
    """Samples in an iteration."""
    iteration: int
    """Number of complete iterations."""
    samples: int
    """Samples in all iterations so far."""

    def __init__(
        self,
        env: Env,
        policy: GaussianPolicy | None = None,
        value: ValueFunction | None = None,
        config: RslRlConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        check_kind("env of RslRlLearner", env, Env, "as lw.make(...) makes it")
        check_kind("config of RslRlLearner", config, RslRlConfig | None, "as RslRlConfig(num_steps_per_env=24)")
        check_kind("policy of RslRlLearner", policy, GaussianPolicy | None, "as lw.load(run) returns it")
        check_kind("value of RslRlLearner", value, ValueFunction | None, "as lw.load_value(run) returns it")
        config, seed = config or RslRlConfig(), whole_number("seed", seed, low=0)
        self.worlds = RslRlVecEnv(env)
        if policy is not None:
            check_networks(policy, value, env)
            config = fitted_config(config, policy.shape, value.shape if value is not None else {})
        elif value is not None:
            raise ValueError("a value function belongs to a policy: give the policy, too")
        if value is not None and value.group != config.group(env):
            config = dataclasses.replace(config, value_group=value.group)
        self.env, self.team, self.config, self.seed = env, Team(), config, seed
        device, nobs, nact = env.obs.device, env.obs_space.size, env.action_space.size
        group = config.group(env)
        self._random = OwnRandomNumbers(device, seed)
        runner = config.runner_config(env)
        kind = resolve_callable(runner["algorithm"]["class_name"])
        networks: dict[str, Any] = {"normalize": config.normalize, **(ENDLESS if config.normalize else {})}
        with self._random, contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its networks
            self.ppo = kind.construct_algorithm(self.worlds.get_observations(), self.worlds, runner, str(device))
            self.policy = GaussianPolicy(nobs, nact, config.hidden, activation=config.activation, **networks)
            self.value = ValueFunction(
                env.obs_spaces[group].size, config.value_hidden, activation=config.value_activation, scale=1.0,
                discount=config.gamma, group=group, **networks,
            )  # fmt: skip
        self.policy.to(device)
        self.value.to(device)
        if policy is not None:
            begin_with(self.ppo.actor, self.ppo.critic, policy, value)
        self._copy_networks()
        self._captured = CapturedUpdate(self.ppo) if config.captures(device) else None
        self._update = self._captured or self.ppo.update

        self.rollout = Rollout(env, config.num_steps_per_env, groups=(group,) if config.batched_values else ())
        self._batched: BatchedSampling | None = None
        if config.batched_values:
            self._batched = BatchedSampling(self.ppo, self.rollout, final=config.bootstrap == "final")
        self.count = config.num_steps_per_env * env.nworld
        self.iteration = self.samples = 0
        self._recent: collections.deque[float] = collections.deque(maxlen=RECENT)
        self._evaluate_mean = MeanPolicyEvaluation(env, config.mean_episodes, self.team)
        self.rollout.restart()
        if config.random_start:
            self.rollout.stagger(torch.Generator(device).manual_seed(seed), self.team)

    def __iter__(self) -> Iterator[RslRlIteration]:
        return self

    def __next__(self) -> RslRlIteration:
        config, ppo, rollout = self.config, self.ppo, self.rollout
        timer = PhaseTimer(self.env.obs.device)
        with self._random, _precision(tf32=config.tf32 and self.env.obs.device.type == "cuda"):
            ppo.train_mode()
            freeze_normalizers(ppo)
            self._sample()
            timer.mark()
            ppo.entropy_coef = config.entropy_weight(self.iteration + 1)
            losses = self._update()
            if config.normalize_when == "after":
                self._take_in(ppo.storage.observations)
        self._copy_networks()
        episodes = finished(rollout)
        numbers = [
            *episodes, *finished_metrics(rollout), rollout.reward.double().mean(), rollout.faults.sum(),
            self._divergence(), self.policy.log_std.exp().mean(), self._finite(),
        ]  # fmt: skip
        # one copy brings the numbers to the host, and another one the returns
        found = torch.stack([number.detach().double() for number in numbers]).tolist()
        ended = rollout.episode_return[rollout.done & ~rollout.episode_return.isnan()]
        timer.mark()
        sums, rest = EpisodeSums(*found[: len(episodes)]), found[len(episodes) :]
        *metrics, reward, faults, kl, std, finite = rest
        self._check_update(losses, bool(finite))
        self._recent.extend(ended[-RECENT:].tolist())
        self.iteration += 1
        self.samples += self.count

        mean: dict[str, Any] = dict.fromkeys(MEAN_STATISTICS)
        if config.mean_every and self.iteration % config.mean_every == 0:
            mean = self._evaluate_mean(self.policy)
        timer.mark()
        statistics = episode_statistics([sums])
        if self.env.task.functions["success"] is None:
            statistics["success"], mean["mean_success"] = math.nan, None
        time_sample, time_update, time_mean = timer.seconds()
        return RslRlIteration(
            iteration=self.iteration,
            samples=self.samples,
            reward_mean=reward,
            **statistics,
            return_recent=sum(self._recent) / len(self._recent) if self._recent else math.nan,
            **mean,
            kl=kl,
            std_mean=std,
            learning_rate=ppo.learning_rate,
            surrogate_loss=losses["surrogate"],
            entropy=losses["entropy"],
            value_loss=losses["value"],
            faults=round(faults),
            time_sample=time_sample,
            time_update=time_update,
            time_mean=time_mean,
            samples_per_second=self.count / time_sample,
            metrics={
                name: total / sums.episodes if sums.episodes else math.nan
                for name, total in zip(self.env.metrics, metrics, strict=True)
            },
        )

    def _sample(self) -> None:
        """Fill rsl_rl's storage with steps of the current policy, and compute the advantages."""
        ppo, env, rollout, when = self.ppo, self.env, self.rollout, self.config.normalize_when
        rollout.begin()
        with torch.inference_mode(), one_thread():
            if self._batched is not None:
                self._batched.sample(self._take_in_step if when == "step" else _nothing)
                if when == "before":
                    self._take_in(ppo.storage.observations)
                self._batched.value()
                return
            obs = self.worlds.get_observations()
            for _ in range(self.config.num_steps_per_env):
                env.action.copy_(ppo.act(obs))
                rollout.store_inputs()
                obs, reward, done, extras = self.worlds.step(env.action)
                rollout.store_outputs()
                ppo.process_env_step(obs, reward, done, extras)
                if when == "step":
                    self._take_in_step()
            ppo.compute_returns(obs)
            if when == "before":
                self._take_in(ppo.storage.observations)

    def _take_in_step(self) -> None:
        self._take_in(self.env.obs_groups)

    def _take_in(self, obs: Mapping[str, torch.Tensor]) -> None:
        """Take observations into the normalisers of both networks."""
        for network in (self.ppo.actor, self.ppo.critic):
            take_in(network, obs)

    def _copy_networks(self) -> None:
        copy_policy(self.ppo.get_policy(), self.policy)
        copy_value(self.ppo.critic, self.value)

    @torch.no_grad()
    def _divergence(self) -> torch.Tensor:
        """KL divergence from the policy that sampled to the present one, averaged over the samples."""
        old_mean, old_std = self.ppo.storage.distribution_params
        log_std = self.policy.log_std
        square = (old_mean - self.policy(self.rollout.obs)).square() + old_std.square()
        return (log_std - old_std.log() + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1).mean()

    def _finite(self) -> torch.Tensor:
        """Whether all weights are finite."""
        parameters = [*self.policy.parameters(), *self.value.parameters()]
        return torch.stack([parameter.detach().isfinite().all() for parameter in parameters]).all()

    def _check_update(self, losses: Mapping[str, float], finite: bool) -> None:
        """End learning where the update is not finite: rsl_rl cannot go on from there."""
        if not finite or not all(map(math.isfinite, losses.values())):
            raise FloatingPointError(
                f"the update of iteration {self.iteration + 1} is not finite: make learning_rate, or the rewards, "
                "smaller"
            )

    def settings(self) -> dict[str, Any]:
        """The hyperparameters as a run's config.json holds them."""
        return dataclasses.asdict(self.config)

    def state_dict(self) -> dict[str, Any]:
        """The state on which the next iteration depends."""
        state = {
            "ppo": self.ppo.save(),
            "learning_rate": self.ppo.learning_rate,
            "random": self._random.state_dict(),
            "env": self.env.get_state(),
            "returns": self.rollout.running_return,
            "recent": list(self._recent),
            "iteration": self.iteration,
            "samples": self.samples,
        }
        with torch.inference_mode(False):
            return copy.deepcopy(state)  # a module's own state_dict shares memory with its parameters

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: The state has another number of worlds, or does not fit for another reason.
        """
        if len(state["env"]) != self.env.nworld:
            raise ValueError(f"the state has {len(state['env'])} worlds, but the environment has {self.env.nworld}")
        for network in (self.ppo.actor, self.ppo.critic):
            make_writable(network)
        self.ppo.load(state["ppo"], None, True)
        for entry in self.ppo.optimizer.state.values():  # Adam counts its steps on the host
            if "step" in entry:
                entry["step"] = entry["step"].cpu()
        self.ppo.learning_rate = state["learning_rate"]
        if self._captured is not None:
            self._captured.bind()
        self._copy_networks()
        self._random.load_state_dict(state["random"])
        self.env.set_state(state["env"].to(self.env.obs.device))
        self.rollout.running_return.copy_(state["returns"])
        self._recent.clear()
        self._recent.extend(state["recent"])
        self.iteration, self.samples = state["iteration"], state["samples"]


def _nothing() -> None:
    pass


@contextlib.contextmanager
def _precision(*, tf32: bool) -> Iterator[None]:
    """A block in which matrix products on a GPU may use TensorFloat-32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if tf32 else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
