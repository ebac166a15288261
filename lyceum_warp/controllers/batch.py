"""Run a policy's episodes in many worlds at once, and return them as trajectories."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
import warp as wp

from lyceum_warp.controllers.trajectory import Trajectory, pictures_of, provenance, stacked
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.env import Curriculum, Env, Player, Policy, start_episodes


@torch.no_grad()
def policy_episodes(
    env: Env,
    policy: Policy,
    episodes: int,
    *,
    seed: int | None = None,
    curriculum: Curriculum | None = None,
    controller: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Iterator[Trajectory]:
    """Run a policy for whole episodes from random initial states, and yield them as trajectories.

    The environment must have a horizon and no automatic resets.

    The episodes equal those of ``lw.evaluate`` with the same curriculum, number of worlds and seed (which it derives by
    ``evaluation_seed``). One call of the policy acts in
    all worlds, so the times in a trajectory are those of the whole batch.

    Yields:
        The first episode of each world, then the second episode of each world, and so on.

    Raises:
        NotEnoughMemoryError: The pictures of all worlds do not fit into memory.
    """
    player = Player(policy, env)
    named = {"name": type(policy).__name__, **(controller or {})}
    origin = provenance(env)
    rounds = -(-episodes // env.nworld)
    if seen := sum(env.obs_groups[camera.group][0].nbytes for camera in env.task.cameras):
        check_fit(seen * env.horizon, env.nworld, wp.get_device("cpu"), model=f"{env.horizon} steps with pictures")
    for number in range(rounds):
        if number == 0 or env.task.curriculum:
            start_episodes(env, seed, curriculum, first=number * env.nworld, total=rounds * env.nworld)
        else:
            env.rand_reset()
        states, obs, pictures = [env.get_state().cpu()], [env.obs.cpu().clone()], [pictures_of(env)]
        actions: list[torch.Tensor] = []
        outcomes: list[torch.Tensor] = []
        times: list[tuple[float, float, float]] = []  # action's time, duration of the policy's call, step's end
        lengths = torch.zeros(env.nworld, dtype=torch.long)
        reasons = torch.zeros(env.nworld, dtype=torch.long)
        start = time.perf_counter()
        while not (lengths > 0).all():
            called = time.perf_counter()
            env.action.copy_(player(env.obs) if number or actions else player.first(env.obs))
            actions.append(env.action.cpu().clone())
            applied = time.perf_counter()
            env.step()
            states.append(env.get_state().cpu())
            obs.append(env.final_obs.cpu().clone())
            pictures.append(pictures_of(env))
            outcomes.append(torch.stack([env.reward, env.eval, env.success.float()]).cpu())
            times.append((applied - start, applied - called, time.perf_counter() - start))
            over = env.done.cpu() & (lengths == 0)
            lengths[over] = len(actions)
            reasons[over] = env.done_reason.cpu()[over].long()
            if progress is not None and len(actions) % 10 == 0:
                progress(number * env.horizon + len(actions), rounds * env.horizon)
        for world in range(min(env.nworld, episodes - number * env.nworld)):
            steps = int(lengths[world])
            params = {name: [value[world].tolist()] for name, value in env.task.parameters.per_world.items()}
            rewards, evals, success = torch.stack([row[:, world] for row in outcomes[:steps]], 1)
            unknown = torch.full((steps,), torch.nan, dtype=torch.float64)
            applied_at, policy_times, ends = torch.tensor(times[:steps], dtype=torch.float64).unbind(1)
            yield Trajectory(
                states=torch.stack([row[world] for row in states[: steps + 1]]).double(),
                obs=torch.stack([row[world] for row in obs[: steps + 1]]),
                actions=torch.stack([row[world] for row in actions[:steps]]),
                rewards=rewards, evals=evals, success=success > 0, times=applied_at, ages=policy_times,
                late=torch.zeros(steps, dtype=torch.bool), plan_of=torch.arange(steps), plan_steps=torch.arange(steps),
                plan_starts=applied_at - policy_times, plan_times=policy_times,
                plan_failed=unknown, plan_effective=unknown,
                timestep=env.timestep, period=env.timestep, wall_seconds=ends[-1].item(), mode="sync",
                done_reason=int(reasons[world]), seed=seed, pictures=stacked(pictures[: steps + 1], world),
                controller=named | {"world": env.first_world + world, "episode": number},
                **origin | {"params": origin["params"] | params},
            )  # fmt: skip
