"""Implement the synchronous loop, ``lw.control``: the plant waits for each plan."""

import time

import torch

from lyceum_warp.controllers.controller import Controller
from lyceum_warp.controllers.episode_collector import EpisodeCollector, OnAbort, OnStep, TimedPlan, begin_episode
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.env.env import Env
from lyceum_warp.support.validate import whole_number


@torch.no_grad()
def control(
    env: Env,
    controller: Controller,
    *,
    steps: int | None = None,
    replan_every: int = 1,
    seed: int | None = None,
    reset: bool = True,
    on_step: OnStep | None = None,
    on_abort: OnAbort | None = None,
) -> Trajectory:
    """Control one world, the plant, until its episode ends. The plant waits while the controller plans.

    Args:
        env: The plant, an environment of one world made with ``autoreset=False``.
        controller: The controller; see ``lw.Controller``. Each call makes a plan. The controller must not step ``env``.
        steps: Maximum number of steps; the episode may end earlier.
        replan_every: Number of steps between two plans. The other steps apply further actions of the last plan, so the
            controller needs an attribute ``actions``.
        seed: Seed of the initial state and of the controller.
        reset: Whether to reset the plant and the controller first. If False, the run continues from the plant's state
            and the controller's last plan. ``replan_every`` must be the same as before.
        on_step: Called with a ``ControlProgress`` after each step. Planning times exclude this call.
        on_abort: Called with the trajectory so far if an exception, such as Ctrl-C, ends the run after the first step.
            The trajectory's ``done_reason`` is 0. The exception is then raised again.

    Returns:
        The trajectory of the episode. Its ``period`` is the plant's time step.

    Raises:
        ValueError: The environment has several worlds or automatic resets, or its episode is already over.
        ValueError: The environment has no horizon, and ``steps`` is None.
        ValueError: An action has the wrong shape or is not finite, or a plan is shorter than ``replan_every``.
    """
    every = whole_number("replan_every", replan_every, low=1)
    checked, limit, first = begin_episode(env, controller, steps, seed, reset=reset, on_step=on_step, on_abort=on_abort)
    episode = EpisodeCollector(env, checked, mode="sync", period=env.timestep, seed=seed)
    planned = max(first - 1, 0) // every * every
    plan = None
    try:
        for k in range(limit):
            begun, step = time.perf_counter(), first + k
            if plan is None or step % every == 0:
                actions = checked(episode.states[k], episode.obs[k], checked.passed(planned, step), k)
                index = 0 if plan is None else plan.index + 1
                plan, planned = TimedPlan(index, k, begun, time.perf_counter() - begun, actions), step
                checked.check_horizon(len(actions), every)
                quality = checked.quality()
            env.action[0] = checked.action(plan.actions, k - plan.step)
            episode.before_step(plan, episode.elapsed(), time.perf_counter() - plan.begun, late=False)
            if plan.step == k:
                episode.add_plan(plan, quality)
            env.step()
            episode.after_step(on_step)
            if env.done.item():
                break
        return episode.trajectory(episode.elapsed(), int(env.done_reason.item()))
    except BaseException:
        episode.abort(on_abort, episode.elapsed())
        raise
