"""Run a policy's episodes in many worlds at once, and return them as trajectories."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from lyceum_warp.controllers.trajectory import Trajectory, provenance
from lyceum_warp.env import Env
from lyceum_warp.support.validate import whole_number


@torch.no_grad()
def policy_episodes(
    env: Env,
    policy: Callable[[torch.Tensor], torch.Tensor],
    episodes: int,
    *,
    seed: int | None = None,
    controller: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[Trajectory]:
    """Run a policy for whole episodes from random initial states, and yield them as trajectories.

    The episodes equal those of ``lw.evaluate`` with the same seed and number of worlds. All worlds share a call of the
    policy, so the times in a trajectory are those of the whole batch.

    Yields:
        The first episodes of all worlds, then their second episodes, and so on.
    """
    episodes = whole_number("episodes", episodes, low=1)
    if env.autoreset:
        raise ValueError("trajectories need an environment without automatic resets: make(..., autoreset=False)")
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} may never end without a horizon: make(..., horizon=1000)")
    named = {"name": type(policy).__name__, **(controller or {})}
    origin = provenance(env)
    rounds = -(-episodes // env.nworld)
    for number in range(rounds):
        env.rand_reset(seed if number == 0 else None)
        batch = _Batch(env)
        while not batch.ended:
            batch.step(policy)
            if progress is not None and batch.steps % 10 == 0:
                progress(number * env.horizon + batch.steps, rounds * env.horizon)
        for world in range(min(env.nworld, episodes - number * env.nworld)):
            place = {"world": env.first_world + world, "episode": number}
            own = {name: [value[world].tolist()] for name, value in env.task.parameters.per_world.items()}
            params = {"params": origin["params"] | own}
            yield batch.trajectory(world, seed=seed, controller=named | place, **origin | params)


class _Batch:
    def __init__(self, env: Env) -> None:
        self.env = env
        self._states, self._obs = [env.get_state().cpu()], [env.obs.cpu().clone()]
        self._actions: list[torch.Tensor] = []
        self._outcomes: list[torch.Tensor] = []
        # action's time, duration of the policy's call, step's end
        self._times: list[tuple[float, float, float]] = []
        self._lengths = torch.zeros(env.nworld, dtype=torch.long)
        self._reasons = torch.zeros(env.nworld, dtype=torch.long)
        self._start = time.perf_counter()

    @property
    def steps(self) -> int:
        return len(self._actions)

    @property
    def ended(self) -> bool:
        return bool((self._lengths > 0).all())

    def step(self, policy: Callable[[torch.Tensor], torch.Tensor]) -> None:
        env, begun = self.env, time.perf_counter()
        env.action.copy_(policy(env.obs))
        self._actions.append(env.action.cpu().clone())
        applied = time.perf_counter()
        env.step()
        self._states.append(env.get_state().cpu())
        self._obs.append(env.final_obs.cpu().clone())
        self._outcomes.append(torch.stack([env.reward, env.eval, env.success.float()]).cpu())
        self._times.append((applied - self._start, applied - begun, time.perf_counter() - self._start))
        over = env.done.cpu() & (self._lengths == 0)
        self._lengths[over] = self.steps
        self._reasons[over] = env.done_reason.cpu()[over].long()

    def trajectory(self, world: int, **origin: Any) -> Trajectory:
        env, steps = self.env, int(self._lengths[world])
        states, obs = (torch.stack([row[world] for row in rows[: steps + 1]]) for rows in (self._states, self._obs))
        rewards, evals, success = torch.stack([row[:, world] for row in self._outcomes[:steps]], 1)
        times, policy_times, _ = (
            torch.tensor(column, dtype=torch.float64) for column in zip(*self._times[:steps], strict=True)
        )
        return Trajectory(
            states=states.double(), obs=obs, actions=torch.stack([row[world] for row in self._actions[:steps]]),
            rewards=rewards, evals=evals, success=success > 0, times=times, ages=policy_times,
            late=torch.zeros(steps, dtype=torch.bool), plan_of=torch.arange(steps), plan_steps=torch.arange(steps),
            plan_starts=times - policy_times, plan_times=policy_times,
            plan_failed=torch.full((steps,), torch.nan, dtype=torch.float64),
            plan_effective=torch.full((steps,), torch.nan, dtype=torch.float64),
            timestep=env.timestep, period=env.timestep, wall_seconds=self._times[steps - 1][2], mode="sync",
            done_reason=int(self._reasons[world]), **origin,
        )  # fmt: skip
