"""The synchronous loop: the plant waits for each plan."""

import time

import torch

from lyceum_warp.control.checked_controller import CheckedController
from lyceum_warp.control.controller import Controller
from lyceum_warp.control.episode_collector import (
    EpisodeCollector,
    OnAbort,
    OnStep,
    TimedPlan,
    begin_episode,
    step_limit,
)
from lyceum_warp.control.trajectory import Trajectory
from lyceum_warp.env import Env


@torch.no_grad()
def control(
    env: Env,
    controller: Controller,
    *,
    steps: int | None = None,
    seed: int | None = None,
    reset: bool = True,
    on_step: OnStep | None = None,
    on_abort: OnAbort | None = None,
) -> Trajectory:
    """Control one world, the plant, until its episode ends. The plant waits for each plan.

    Args:
        env: The plant: one world, made with ``autoreset=False``.
        controller: Called once a step; see ``lw.Controller``. It must not step ``env``.
        steps: Steps after which to stop if the episode has not ended.
        seed: Seed of the initial state and of the controller.
        reset: Whether to reset the plant and the controller first. With False the run continues from the plant's
            state and the controller's last plan.
        on_step: Called with a ``ControlProgress`` after each step. Its time counts as no plan's time.
        on_abort: Called with the trajectory of the complete steps, if there are any, when an exception ends the run
            (Ctrl-C included). ``done_reason`` of that trajectory is 0. The exception is raised afterwards.

    Returns:
        The episode. Its ``period`` is the plant's time step.

    Raises:
        ValueError: The environment has several worlds or automatic resets, the episode is over or may never end, or
            the controller does not return a finite action of the right shape.
    """
    limit = step_limit(env, steps)
    checked = CheckedController(controller, env)
    begin_episode(env, checked, seed, reset=reset)
    episode = EpisodeCollector(env, checked, mode="sync", period=env.timestep, seed=seed)
    shift = 0 if reset else 1
    try:
        for k in range(limit):
            begun = time.perf_counter()
            actions = checked(episode.states[k], episode.obs[k], shift, k)
            plan = TimedPlan(k, k, begun, time.perf_counter() - begun, actions)
            env.action[0] = actions[0]
            episode.before_step(plan, episode.elapsed(), time.perf_counter() - begun, late=False)
            episode.add_plan(plan, checked.quality())
            env.step()
            episode.after_step(on_step)
            if env.done.item():
                break
            shift = checked.steps(k + 1) - checked.steps(k)
        return episode.trajectory(episode.elapsed(), int(env.done_reason.item()))
    except BaseException:
        episode.abort(on_abort, episode.elapsed())
        raise
