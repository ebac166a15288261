"""Play every clip of a tracking task from its first frame, without noise."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env, Player, Policy
from lyceum_warp.support.validate import check_kind

HEIGHT, TILT = 0.25, 0.8
"""Errors of the base's height (m) and tilt at which a clip has failed (SuperMimic, appendix F)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClipResults:
    """Results of clips. Every tensor has the shape (clips,) and is on the CPU."""

    seconds: torch.Tensor
    """Durations of the clips."""
    failed: torch.Tensor
    """Whether a clip failed: the base's height was off by more than 0.25 m, or its tilt by more than 0.8, or a fault
    occurred. The tilt is the vertical component of the direction of gravity in the base's axes. Source: SuperMimic
    (arXiv 2610.28480), appendix F."""
    tracked: torch.Tensor
    """Seconds until the clip failed, or the clip's duration."""
    returns: torch.Tensor
    """Sums of rewards until the clip failed."""
    scores: torch.Tensor
    """Sums of all rewards with positive weight until the clip failed, divided by those of perfect tracking; 0 to 1."""
    errors: Mapping[str, torch.Tensor]
    """The task's metrics that are errors, such as "r_mpkpe", averaged over the steps until the clip failed."""
    worst: torch.Tensor
    """Seconds at which the relative error of the bodies' positions was largest until the clip failed."""
    worst_states: torch.Tensor
    """The states at these times, (clips, state_space.size) float64."""

    @property
    def failures(self) -> int:
        """Number of clips that failed."""
        return int(self.failed.sum())

    def to_dict(self) -> dict[str, Any]:
        """Convert the result to values that JSON supports, without the states."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, torch.Tensor)}
        content = {name: value.tolist() for name, value in tensors.items() if name != "worst_states"}
        return content | {name: value.tolist() for name, value in self.errors.items()}


@torch.no_grad()
def evaluate_clips(
    env: Env, policy: Policy, *, progress: Callable[[int, int], object] | None = None, **changes: Any
) -> ClipResults:
    """Play every clip of a tracking task once from its first frame, without noise, pushes and random physics.

    Args:
        env: An environment of the task; its worlds do not change.
        policy: A function that maps observations to actions without noise, or a module whose method ``act`` does this.
        progress: Called every 50 steps with the number of steps so far and the maximum number.
        **changes: Options and parameters that differ from the environment's, such as ``physics="exact"``.

    Raises:
        ValueError: The task tracks no clips, or the policy does not fit the task.
    """
    check_kind("env of evaluate_clips", env, Env, "as lw.make('g1_tracking') makes it")
    worlds = clip_worlds(env, **changes)
    act = Player(policy, worlds)
    act.first(worlds.obs)  # checks the policy
    definition, params = worlds.task.definition, worlds.task.params
    steps = torch.as_tensor(params["ranges"][:, 1].copy()).to(worlds.obs.device) - 1
    terms = [name for name in definition.rewards if params[name] > 0.0]
    names = [name for name in definition.metrics if name not in ("base_height_error", "base_tilt_error")]
    sums = torch.zeros(3 + len(names), worlds.nworld, device=worlds.obs.device)
    failed = torch.zeros_like(worlds.done)
    worst, worst_at = torch.full_like(worlds.reward, -1.0), torch.zeros_like(steps)
    states = worlds.get_state()
    for step in range(1, int(steps.max()) + 1):
        worlds.step(act(worlds.obs))
        metrics = worlds.metrics
        playing = ~failed & (steps >= step)
        faulty = worlds.done & (steps > step)
        off = (metrics["base_height_error"] > HEIGHT) | (metrics["base_tilt_error"] > TILT) | faulty
        failed |= playing & off
        playing &= ~off
        gain = torch.stack([metrics[name] for name in terms]).sum(0)
        now = torch.stack([torch.ones_like(gain), worlds.reward, gain, *(metrics[name] for name in names)])
        sums += torch.where(playing, now, 0.0)
        worse = playing & (metrics["r_mpkpe"] > worst)
        worst = torch.where(worse, metrics["r_mpkpe"], worst)
        worst_at = torch.where(worse, step, worst_at)
        states = torch.where(worse[:, None], worlds.get_state(), states)
        if progress is not None and step % 50 == 0:
            progress(step, int(steps.max()))
    count, returns, gains, *errors = sums.cpu()
    best = worlds.timestep * sum(float(params[name]) for name in terms)
    return ClipResults(
        seconds=steps.cpu() * worlds.timestep, failed=failed.cpu(), tracked=count * worlds.timestep, returns=returns,
        scores=gains / (best * steps.cpu()),
        errors={name: total / count.clamp_min(1.0) for name, total in zip(names, errors, strict=True)},
        worst=worst_at.cpu() * worlds.timestep, worst_states=states.cpu(),
    )  # fmt: skip


def clip_worlds(env: Env, **changes: Any) -> Env:
    """Make worlds that begin at the first frame of each clip, without anything random, and that never fail.

    Raises:
        ValueError: The task tracks no clips.
    """
    if "start_clip" not in env.task.params:
        raise ValueError(f"the task {env.task.name!r} tracks no clips: it has no parameter 'start_clip'")
    clips = changes.pop("clips", env.task.params["clips"])
    count = int((np.asarray(clips)[:, 0] == 0.0).sum())
    calm = {"start_frame": 0, "randomness": 0.0, "height_limit": 1e6, "tilt_limit": 1e6}
    return env.replicate(
        nworld=count, horizon=0, autoreset=False, clips=clips, start_clip=np.arange(count), **calm | changes
    )
