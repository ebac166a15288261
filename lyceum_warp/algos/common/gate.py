"""Test whether a policy passes its task's gate, on the C engine under exact physics."""

from typing import Any

import torch

from lyceum_warp.core.gate import Verdict
from lyceum_warp.engines.placement import options_on_cores
from lyceum_warp.env.curriculum import Curriculum, start_episodes
from lyceum_warp.env.env import Env
from lyceum_warp.env.player import Player, Policy
from lyceum_warp.support.validate import check_kind, whole_number


@torch.no_grad()
def gate(
    env: Env,
    policy: Policy,
    *,
    seed: int = 0,
    curriculum: Curriculum | None = None,
    nthread: int | None = None,
    quick: bool = False,
) -> Verdict:
    """Test whether a policy passes the gate of its task, such as whether a robot walks.

    The worlds have the environment's parameters, but run on the C engine under the task's exact physics.

    Args:
        env: An environment of the task; its worlds do not change.
        policy: A function that maps observations to actions without noise, or a module whose method ``act`` does this.
        seed: Seed of the worlds.
        curriculum: How far curricula have come, such as ``lw.load_curriculum(run)``; by default as far as in ``env``.
        nthread: Threads of the C engine; by default all cores.
        quick: Whether to leave out all parts of the gate after one that fails, and those that have no limits.

    Raises:
        ValueError: The task has no gate, or the policy does not fit the task.
    """
    check_kind("env of gate", env, Env, "as lw.make(...) makes it")
    seed, test = whole_number("seed", seed, low=0), env.task.definition.gate
    if test is None:
        raise ValueError(f"the task {env.task.name!r} has no gate: set its attribute gate to a lw.Gate")
    curriculum = curriculum or Curriculum.of(env)
    options = {**options_on_cores(), "physics": "exact", "horizon": 0, "seed": seed, "nthread": nthread}
    player: Player

    def worlds(nworld: int, **params: Any) -> Env:
        replica = env.replicate(nworld=nworld, **options, **params)
        start_episodes(replica, None, curriculum)
        nonlocal player
        player = Player(policy, replica)
        player.first(replica.obs)  # checks the policy
        return replica

    numbers: dict[str, float] = {}
    limits = {name: limit for name, limit in test.limits.items() if limit.range}
    for part in test.measure(worlds, lambda obs: player(obs)):
        numbers |= part
        fails = any(name in limits and not limits[name].allows(number) for name, number in part.items())
        if quick and (fails or limits.keys() <= numbers.keys()):
            break
    return Verdict(task=env.task.name, seed=seed, memory=curriculum.text, numbers=numbers, limits=test.limits)
