"""Evaluate policies in whole episodes, without exploration noise."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.env import Curriculum, Env, Player, Policy, start_episodes
from lyceum_warp.support.validate import check_kind, described, whole_number

_MEAN_SEED = 2**31 - 1
_MEAN_STATISTICS = ("mean_return", "mean_length", "mean_terminal_reward", "mean_eval", "mean_success")


def evaluation_seed(seed: int) -> int:
    """Derive a seed for evaluation from the training seed. The two seeds give different initial states."""
    return whole_number("seed", seed, low=0) ^ 0x5A17C3E9


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Results of finished episodes. Every tensor has the shape (episodes,) and is on the CPU."""

    returns: torch.Tensor
    """Sums of rewards."""
    lengths: torch.Tensor
    """Numbers of steps."""
    rewards: torch.Tensor
    """Reward of each episode's last step."""
    evals: torch.Tensor
    """The evaluation metric at the end of each episode."""
    success: torch.Tensor
    """1.0 for each episode that ended with the goal met, otherwise 0.0."""
    terminated: torch.Tensor
    """1.0 for each episode that ended by termination, otherwise 0.0. Time limits and faults are not terminations."""
    metrics: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    """Each metric of the task, summed over the steps of an episode."""
    objects: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    """Whether each episode was played with an object, by the object's name, bool."""
    curriculum: Curriculum = dataclasses.field(default_factory=Curriculum)
    """The curriculum at which the episodes began; its ``lasting`` memory has one row for each episode."""

    def first(self, count: int) -> "Episodes":
        """Select the first ``count`` episodes."""
        return self.select(slice(count))

    def select(self, rows: Any) -> "Episodes":
        """Select episodes by an index, a slice or a mask, (episodes,) bool."""
        lasting = {name: values[rows] for name, values in self.curriculum.lasting.items()}
        tensors = {name: part[rows] for name, part in vars(self).items() if isinstance(part, torch.Tensor)}
        return Episodes(
            **tensors,
            metrics={name: sums[rows] for name, sums in self.metrics.items()},
            objects={name: held[rows] for name, held in self.objects.items()},
            curriculum=dataclasses.replace(self.curriculum, lasting=lasting),
        )

    @property
    def step_metrics(self) -> dict[str, torch.Tensor]:
        """Each metric of the task, averaged over the steps of an episode."""
        return {name: sums / self.lengths for name, sums in self.metrics.items()}


@torch.no_grad()
def evaluate(
    env: Env,
    policy: Policy,
    episodes: int,
    *,
    seed: int | None = None,
    curriculum: Curriculum | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Episodes:
    """Run a policy without noise for whole episodes from random initial states.

    Every world contributes the same number of episodes. Otherwise, worlds with short episodes would contribute more
    episodes and bias the results. If the task has a curriculum in lasting memory, one episode does not change the level
    of the next: all worlds play one episode, and then begin again as if they were further worlds. If worlds keep
    different objects, they begin again, too, so that a seed leads to all objects.

    Args:
        env: The environment; its worlds are reset.
        policy: A function that maps observations (nworld, nobs) to actions (nworld, nact), or a module whose method
            ``act`` does this. For a policy with memory, see docs/memory.md.
        episodes: Number of episodes, rounded up to a multiple of the number of worlds.
        seed: Seed of the initial states. ``evaluate`` and ``lw.make`` draw different initial states from the same seed.
            Without a seed, the worlds continue their random streams.
        curriculum: How far curricula have come, such as ``lw.load_curriculum(run)``. By default, lasting memory begins
            anew if a seed is given, and shared memory is that of the environment.
        progress: Called every 50 steps with the number of steps so far and the maximum number.

    Raises:
        ValueError: The task has no horizon, the environment was made with ``autoreset=False``, the policy hides
            memory, or the policy or the curriculum does not fit the environment.
    """
    check_kind("env of evaluate", env, Env, "as lw.make(...) makes it")
    if not callable(policy):
        raise ValueError(f"policy must be a function of observations, not {described(policy)}")
    episodes = whole_number("episodes", episodes, low=1)
    check_kind("progress", progress, Callable | None, "a function")
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} never end without a horizon: give make() a horizon")
    if not env.autoreset:
        raise ValueError(
            "evaluate needs an environment that resets automatically: make the environment with autoreset=True"
        )
    player, each = Player(policy, env), -(-episodes // env.nworld)
    check_fit(8 * (7 + len(env.episode_metrics)) * each, env.nworld, env.device, model=f"{each} episodes")
    seed = None if seed is None else evaluation_seed(seed)
    several = len(env.task.objects) > 1 and not env.task.redraws
    rounds = each if env.task.curriculum or several else 1
    if curriculum is None and seed is None and rounds > 1:
        curriculum = Curriculum.of(env)
    results = torch.zeros(7 + len(env.metrics), each, env.nworld, device=env.obs.device)
    starts = []
    for number, part in enumerate(results.chunk(rounds, 1)):
        start_episodes(env, seed, curriculum, first=number * env.nworld, total=each * env.nworld)
        starts.append({name: env.lasting[name].cpu().clone() for name in env.task.curriculum})
        for t in _play(env, player, part):
            if progress is not None:
                progress(number * env.horizon + t, each * env.horizon)
    columns = results.flatten(1).cpu()
    metrics = dict(zip(env.episode_metrics, columns[7:], strict=True))
    objects = {name: columns[6] == index for name, index in env.task.objects.items()}
    lasting = {name: torch.cat([start[name] for start in starts]) for name in env.task.curriculum}
    start = Curriculum(shared={name: memory.cpu().clone() for name, memory in env.shared.items()}, lasting=lasting)
    names = ("returns", "lengths", "rewards", "evals", "success", "terminated")
    return Episodes(**dict(zip(names, columns[:6], strict=True)), metrics=metrics, objects=objects, curriculum=start)


def _play(env: Env, player: Player, results: torch.Tensor) -> Iterator[int]:
    """Write the results of each world's first episodes into (numbers, episodes, nworld). Yield every 50 steps."""
    each, worlds = results.shape[1], torch.arange(env.nworld, device=env.obs.device)
    count, total = torch.zeros_like(worlds), torch.zeros_like(env.reward)
    for t in range(1, each * env.horizon + 1):
        length = env.episode_step + 1.0
        held = env.field("object").flatten().clone() if env.task.objects else torch.zeros_like(total)
        env.action.copy_(player.first(env.obs) if t == 1 else player(env.obs))
        env.step()
        total += env.reward
        ends = (env.success.float(), env.terminated.float())
        now = torch.stack([total, length, env.reward, env.eval, *ends, held, *env.episode_metrics.values()])
        slot = count.clamp_max(each - 1)
        counts = env.done & (count < each)
        results[:, slot, worlds] = torch.where(counts, now, results[:, slot, worlds])
        total.masked_fill_(env.done, 0.0)
        count += counts
        if t % 50 == 0:
            yield t
            if bool((count >= each).all()):
                return


ENDLESS_STEPS = 1000


def evaluation_worlds(env: Env, nworld: int, **changes: Any) -> Env:
    """Copy an environment for an evaluation; for ``changes``, see ``Env.replicate``."""
    endless = {} if env.horizon else {"horizon": ENDLESS_STEPS}
    return env.replicate_few(nworld, **(endless | changes))


class MeanPolicyEvaluation:
    """Evaluates the policy without noise during training, in a separate, small environment on rank 0.

    All evaluations start from the same initial states, and at the curriculum that training has reached.
    """

    def __init__(self, env: Env, config: Any, team: Team) -> None:
        self.env, self.team = env, team
        self.every, self.episodes = config.mean_every, config.mean_episodes
        self._few: Env | None = None

    def added(self, statistics: Mapping[str, Any], policy: torch.nn.Module, iteration: int) -> dict[str, Any]:
        """Evaluate the policy if due, and add the results to the statistics; otherwise, the results are None."""
        results: dict[str, Any] = dict.fromkeys(_MEAN_STATISTICS)
        if self.every > 0 and iteration % self.every == 0:
            means = torch.zeros(len(results), dtype=torch.float64, device=self.env.obs.device)
            if self.team.leads:
                if self._few is None:
                    self._few = evaluation_worlds(self.env, self.episodes)
                self._few.follow(self.env)
                episodes = evaluate(
                    self._few, policy, self.episodes, seed=_MEAN_SEED, curriculum=Curriculum.of(self.env)
                )
                parts = (episodes.returns, episodes.lengths, episodes.rewards, episodes.evals, episodes.success)
                means.copy_(torch.stack([part.mean() for part in parts]))
            self.team.copy_leader([means])
            results = dict(zip(results, means.tolist(), strict=True))
        success = self.env.task.functions["success"] is not None
        return {**statistics, **results} | ({} if success else {"success": math.nan, "mean_success": None})
