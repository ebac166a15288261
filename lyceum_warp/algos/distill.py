"""Learn a student policy that imitates a teacher: another policy, or the actions of saved episodes.

A student acts in the worlds, and a teacher with other observations says what it would do there (DAgger; Ross et al.
2011, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning"). An update equals one
of rsl_rl's algorithm Distillation. With saved episodes instead, the student sees only the states of these episodes
(behaviour cloning).
"""

import copy
import dataclasses
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any, Literal

import torch
from torch import nn

from lyceum_warp.algos.common.adam import GradientStep
from lyceum_warp.algos.common.distributed import Captured, Team
from lyceum_warp.algos.common.hyperparameters import GROUP, PICTURE_RULES, Activation, PictureConfig
from lyceum_warp.algos.common.minibatches import precision
from lyceum_warp.algos.common.networks import initialize_as_torch, trainable
from lyceum_warp.algos.common.pictures import policy_inputs, policy_settings, shift_pictures
from lyceum_warp.algos.common.policy import GaussianPolicy
from lyceum_warp.algos.common.policy_check import check_policy, check_sizes
from lyceum_warp.algos.common.rollout_buffer import Rollout
from lyceum_warp.algos.common.rollout_statistics import SampledIteration, gathered
from lyceum_warp.algos.common.sampling import SamplingLearner
from lyceum_warp.algos.common.timing import PhaseTimer, one_thread
from lyceum_warp.env import Env, Player
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, check_group

_EPS = 1e-2
"""Constant that is added to the normaliser's standard deviations, as in PPO."""

_RULES: dict[str, Rule] = {
    "num_steps": 1, "epochs": 1, "gradient_length": 1, "learning_rate": 0.0, "max_grad_norm": 0.0,
    "log_std": (-13.8, 13.8), "recurrent": 0, "mean_every": 0, "mean_episodes": 1, "teacher_group": GROUP,
    **PICTURE_RULES,
}  # fmt: skip


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class DistillConfig(PictureConfig):
    """Hyperparameters of ``Distill``.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    num_steps: int = 24
    """Number of steps of every world per iteration."""
    epochs: int = 2
    """Number of passes over an iteration's samples."""
    gradient_length: int = 12
    """Number of steps of all worlds per step of Adam, which must divide ``num_steps``. A student with memory is
    differentiated through these steps."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    max_grad_norm: float = 1.0
    """Maximum Euclidean norm of the gradient."""
    loss: Literal["mse", "huber"] = "mse"
    """Loss between the actions of student and teacher: the mean squared error, or the Huber loss. The losses of the
    steps are added up."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the student's hidden layers."""
    recurrent: int = 0
    """Units of a GRU before the student's hidden layers, which gives the student memory; 0 means no memory."""
    activation: Activation = "elu"
    """Activation of the student's hidden layers."""
    log_std: float = -2.3
    """Logarithm of the standard deviations with which the student acts, and with which PPO may continue."""
    normalize: bool = True
    """Whether to normalise the student's observations by their running mean and variance."""
    teacher_group: str | None = None
    """Group of observations for the teacher; by default "teacher" if the task has this group, else "policy"."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    mean_every: int = 20
    """Iterations between evaluations of the student without noise; 0 means no evaluations."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the student."""

    def __post_init__(self) -> None:
        check_fields(self, _RULES)
        if self.num_steps % self.gradient_length:
            raise ValueError(f"gradient_length={self.gradient_length} must divide num_steps, which is {self.num_steps}")


class Demonstrations(nn.Module):
    """Saved episodes of a policy or a planner as a teacher.

    Example:
        >>> episodes = lyceum_warp.controllers.load_episodes("runs/episodes").values()
        >>> learner = lw.Distill(env, teacher=lw.Demonstrations(episodes))

    Args:
        episodes: The episodes, ``lw.Trajectory`` or other objects with the tensors ``obs``, (steps + 1, nobs), and
            ``actions``, (steps, nact). For a student that sees cameras, ``pictures`` maps their groups to tensors,
            (steps + 1, height, width, channels).

    Raises:
        ValueError: There is no episode.
    """

    obs: torch.Tensor
    """The observations before all steps of all episodes, (steps, nobs)."""
    action: torch.Tensor
    """The actions, (steps, nact)."""
    step: torch.Tensor
    """Number of steps since the episode's start, (steps,)."""
    shape: dict[str, Any]

    def __init__(self, episodes: Iterable[Any]) -> None:
        super().__init__()
        episodes = list(episodes)
        parts = [(each.obs[: len(each.actions)], each.actions, torch.arange(len(each.actions))) for each in episodes]
        if not parts:
            raise ValueError("there is no episode to imitate: pass at least one")
        for name, rows in zip(("obs", "action", "step"), zip(*parts, strict=True), strict=True):
            self.register_buffer(name, torch.cat(rows).float())
        self.nobs, self.nact = self.obs.shape[1], self.action.shape[1]
        kinds: dict[str, list[Any]] = {}
        for number, (group, first) in enumerate(getattr(episodes[0], "pictures", {}).items()):
            kinds[group] = [str(first.dtype).removeprefix("torch."), *first.shape[1:]]
            seen = torch.cat([each.pictures[group][: len(each.actions)] for each in episodes])
            self.register_buffer(f"pictures_{number}", seen)  # a group's name may be no name of an attribute
        self.shape = {"steps": len(self.obs), "nobs": self.nobs, "nact": self.nact, "pictures": kinds}

    @property
    def obs_groups(self) -> dict[str, torch.Tensor]:
        """``obs``, as the group "policy", and the pictures before all steps, (steps, height, width, channels)."""
        pictures = {group: getattr(self, f"pictures_{number}") for number, group in enumerate(self.shape["pictures"])}
        return {"policy": self.obs, **pictures}

    @staticmethod
    def like(shape: Mapping[str, Any]) -> "Demonstrations":
        """Make demonstrations with the given ``shape``, whose content is loaded later."""
        obs, actions = (torch.empty(shape["steps"], shape[size]) for size in ("nobs", "nact"))
        pictures = {
            group: torch.empty(shape["steps"], *size, dtype=getattr(torch, dtype))
            for group, (dtype, *size) in shape.get("pictures", {}).items()
        }
        return Demonstrations([SimpleNamespace(obs=obs, actions=actions, pictures=pictures)])


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistillIteration(SampledIteration):
    """Statistics of one iteration of ``Distill``.

    Episode statistics describe the episodes of the student, which acts with noise. They are None with demonstrations.
    """

    loss: float
    """Mean loss between the actions of student and teacher, over the iteration's updates."""
    time_update: float
    """Seconds for the update."""


class Distill(SamplingLearner):
    """Infinite iterator of ``DistillIteration`` that learns a student policy from a teacher.

    Example:
        >>> teacher = lw.load(lw.pretrained_run("go1_velocity"))
        >>> env = lw.make("go1_student_velocity", nworld=4096, device="cuda")
        >>> for it in Distill(env, config=DistillConfig(recurrent=256), teacher=teacher):
        ...     print(it.loss)

    Args:
        env: The environment, which must not be stepped between iterations.
        policy: The student; by default a new policy.
        config: Hyperparameters.
        teacher: A policy, a module with ``act``, ``nobs`` and ``nact``; or ``Demonstrations``, which are observations
            of the group "policy" with actions. The worlds do not step with demonstrations: they only set how many
            places in the episodes one iteration learns from.
        seed: Seed of a new student and of the noise.
        team: The processes that learn together, each with some of the worlds.

    Raises:
        ValueError: The environment does not reset automatically, or the student or the teacher does not fit it.
        FloatingPointError: The loss, or a parameter, is not finite after an iteration.
    """

    config_type, sees = DistillConfig, True
    algorithm = "distill"
    """The name of the algorithm in a run's config.json."""
    config: DistillConfig
    """Hyperparameters."""
    policy: GaussianPolicy
    """The student."""
    teacher: nn.Module
    group: str
    """Group of the teacher's observations."""

    def __init__(
        self,
        env: Env,
        policy: GaussianPolicy | None = None,
        config: DistillConfig | None = None,
        *,
        teacher: nn.Module,
        seed: int = 0,
        team: Team | None = None,
    ) -> None:
        super().__init__(env, config, seed=seed, team=team)
        config, team, device = self.config, self.team, env.obs.device
        self._clones = isinstance(teacher, Demonstrations)
        if not (self._clones or all(hasattr(teacher, name) for name in ("act", "nobs", "nact"))):
            raise ValueError(f"teacher must be a policy with act, nobs and nact, or lw.Demonstrations, not {teacher!r}")
        default = "teacher" if "teacher" in env.obs_groups else "policy"
        self.group = "policy" if self._clones else config.teacher_group or default
        check_group(self.group, env.obs_groups, env.task.name)
        check_sizes(teacher, env, "the teacher", group=self.group)
        if policy is not None:
            check_policy(trainable(policy), env, twice=False)
        init = torch.Generator().manual_seed(self.seed)
        nobs, sees = policy_inputs(env, config)
        self.policy = policy or GaussianPolicy(
            nobs, env.action_space.size, config.hidden, recurrent=config.recurrent, activation=config.activation,
            log_std=config.log_std, normalize=config.normalize, generator=init, **sees,
        )  # fmt: skip
        if policy is None:
            initialize_as_torch(getattr(self.policy.network, "network", self.policy), init)  # not the encoders
        demonstrated = teacher.obs_groups if isinstance(teacher, Demonstrations) else env.obs_groups
        for group, size in self.policy.pictures.items():
            if group not in demonstrated or demonstrated[group].shape[1:] != size:
                raise ValueError(
                    f"the demonstrations have no pictures {group!r} of the shape {tuple(size)}: save the episodes of "
                    "an environment with this camera, or use policy_groups=('policy',)"
                )
        self.config = config = dataclasses.replace(config, **policy_settings(self.policy))
        self.teacher = teacher
        self.policy.to(device)
        self.generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=init)))

        self._burn_in = getattr(self.policy.network, "burn_in", 0)
        if self._burn_in >= config.gradient_length:
            frames = self._burn_in + 1
            raise ValueError(f"gradient_length={config.gradient_length} must be at least frames, which is {frames}")
        steps, nworld = config.num_steps, env.nworld * team.size
        self.count = steps * nworld
        self.rollout = Rollout(env, steps, groups=self.policy.groups)
        self._label = torch.zeros_like(env.action)
        self.label = self.rollout.store_too(self._label)
        """The teacher's actions, (steps, nworld, nact)."""
        self.noise = torch.empty(steps, nworld, env.action_space.size, device=device)
        self._player = Player(self.policy, env)
        self._state, self._next_state = self._player.state.clone(), self._player.state.clone()
        learned = [p for p in self.policy.parameters() if p is not self.policy.log_std]
        self._step = GradientStep(learned, config.learning_rate, team, max_norm=config.max_grad_norm)
        self._loss = torch.zeros(1, device=device)
        self._epoch = Captured(self.learn, team, device)
        self._act = Captured(self._choose, team, device)
        self._observe = Captured(lambda: self.policy.observe(env.obs, team, eps=_EPS), team, device)
        self.rollout.restart()
        players = [self._player]
        if isinstance(teacher, Demonstrations):
            self._demonstrations = copy.deepcopy(teacher).to(device)
            places = torch.randint(len(teacher.obs), (nworld,), generator=torch.Generator().manual_seed(self.seed))
            self._start = places[self.own_worlds].to(device)
            if policy is None:
                self.policy.observe(self._demonstrations.obs, eps=_EPS)
        else:
            with torch.no_grad():
                Player(teacher, env).first(env.obs_groups[self.group])
            self._labels = Player(teacher, env)
            players.append(self._labels)
            self.rollout.stagger(self.generator, team)
        self._remembering = [player for player in players if player.state_size]

    def __next__(self) -> DistillIteration:
        config, rollout, team = self.config, self.rollout, self.team
        timer = PhaseTimer(self.env.obs.device)
        with precision(tf32=config.tf32 and self.env.obs.device.type == "cuda"):
            # 1. Let the student act and the teacher say what it would do, or take the next steps of the episodes.
            if self._clones:
                self.recall()
            else:
                self.sample()
                self.env.update_shared(team.sum)
            timer.mark("sample")

            # 2. Run the epochs.
            self.update()

        # copy all numbers to the host at once
        finite = torch.stack([x.isfinite().all() for x in (self._loss, *self.policy.parameters())]).all()
        loss = self._loss[0] * config.gradient_length / (config.epochs * config.num_steps)
        statistics, (update, *_) = gathered(rollout, team, {"finite": finite, "loss": loss})
        timer.mark("update")
        self._check_finite(update, "observations")
        if self._clones:
            statistics = {"faults": 0}

        # 3. Evaluate the student without noise.
        return self._finished(DistillIteration, timer, statistics | update, rate_of=("sample", "update"))

    @torch.no_grad()
    def sample(self) -> None:
        """Step the worlds with the student's actions, and store the teacher's actions.

        After each step, the normaliser is updated with the step's observations.
        """
        with one_thread():
            self.noise.normal_(generator=self.generator)
            self.policy.observe_pictures(self.env.obs_groups, self.team)
            self._state.copy_(self._player.state)
            self.rollout.fill(self._act, self._observe)

    @torch.no_grad()
    def _choose(self) -> None:
        """Draw the student's actions, and ask the teacher."""
        env, noise = self.env, self.noise.index_select(0, self.rollout.index)[0, self.own_worlds]
        torch.addcmul(self._player(env.obs), noise, self.policy.log_std.exp(), out=env.action)
        self._label.copy_(self._labels(env.obs_groups[self.group]))

    def recall(self) -> None:
        """Take the next steps of the episodes. Each world has its own place in them, and continues at their end."""
        rollout, demonstrations = self.rollout, self._demonstrations
        steps = torch.arange(rollout.steps, device=self._start.device)[:, None]
        index = (self._start + self.iteration * rollout.steps + steps) % len(demonstrations.obs)
        self._state.copy_(self._player.state)
        for group, rows in rollout.obs_groups.items():
            rows.copy_(demonstrations.obs_groups[group][index])
        rollout.step.copy_(demonstrations.step[index])
        self.policy.observe_pictures({group: rows[0] for group, rows in rollout.obs_groups.items()}, self.team)
        self.label.copy_(demonstrations.action[index])

    def update(self) -> None:
        """Run the epochs. Memory goes on from the last one, as in rsl_rl: this state is that of the new student."""
        for group in self.policy.pictures if self.config.random_shift else ():
            shift_pictures(self.rollout.obs_groups[group], self.config.random_shift, self.generator)
        self._loss.zero_()
        for _ in range(self.config.epochs):
            self._epoch()
        self._player.state.copy_(self._next_state)
        self.team.copy_leader(self.policy.parameters())

    def learn(self) -> None:
        """Run an epoch: step through the samples in order, with a step of Adam after each ``gradient_length`` steps."""
        loss_of = nn.functional.mse_loss if self.config.loss == "mse" else nn.functional.huber_loss
        rollout, state, length = self.rollout, self._state, self.config.gradient_length
        groups = {group: rollout.obs_groups[group] for group in self.policy.groups}
        for t in range(0, rollout.steps, length):
            # repeat the steps whose features an older encoder would have computed
            first = max(t - self._burn_in, 0)
            part = slice(first, t + length)
            obs = self.policy.inputs({group: rows[part] for group, rows in groups.items()})
            mean, states = self.policy.unrolled(obs, state, rollout.step[part] == 0.0)
            loss = loss_of(mean[t - first :], self.label[t : t + length])
            self._loss += self._step(length * loss / self.team.size) / length
            state = states[length - self._burn_in - 1 + t - first].detach()
        self._next_state.copy_(states[-1].detach())

    def enter(self, env: Env) -> None:
        """Go on in another environment of the same task; see ``Learner``."""
        state, make = self.state_dict(), self.__init__  # type: ignore[misc]
        make(env, self.policy, self.config, teacher=self.teacher, seed=self.seed, team=self.team)
        self.load_state_dict(state)

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state; see ``Learner``."""
        state = {
            "optimizer": self._step.optimizer.state_dict(),
            "memory": [self.team.gather(player.state) for player in self._remembering],
        }
        return super().state_dict() | copy.deepcopy(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self._step.optimizer.load_state_dict(state["optimizer"])
        self._epoch.forget()  # the graph contains the learning rate
        for player, memory in zip(self._remembering, state["memory"], strict=True):
            player.state.copy_(memory[self.own_worlds])
