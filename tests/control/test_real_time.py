"""Controllers in step with the world and against the clock."""

import math
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.control import loop as module
from lyceum_warp.control.control_report import control_report
from lyceum_warp.control.controller import CheckedController
from lyceum_warp.control.loop import ControlProgress, control, control_async
from lyceum_warp.control.trajectory import Trajectory


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


def towards(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
    """Push the point to its target."""
    x, y, vx, vy, tx, ty = obs
    return torch.stack([2 * (tx - x) - vx, 2 * (ty - y) - vy]).clamp(-1, 1)


class Planner:
    """Says in its actions which state they were planned from, and for how many steps later they are."""

    def __init__(self, env: lw.Env, horizon: int = 8, seconds: float = 0.0) -> None:
        self.timestep = env.timestep
        self.actions = torch.zeros(horizon, 2)
        self.seconds = seconds
        self.column = env.state_space.parts["step"].start
        self.shifts: list[int] = []
        self.resets: list[int | None] = []

    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None, *, shift: int = 1) -> torch.Tensor:
        assert not torch.is_grad_enabled()
        self.shifts.append(shift)
        time.sleep(self.seconds)
        self.actions[:, 0] = state[self.column].float() / 100
        self.actions[:, 1] = torch.arange(len(self.actions)) / 100
        return self.actions[0].clone()

    def reset(self, seed: int | None = None) -> None:
        self.resets.append(seed)


# in step


def test_an_episode(env: lw.Env) -> None:
    seen: list[ControlProgress] = []
    episode = control(env, towards, seed=3, on_step=seen.append)
    assert episode.steps == 40 and episode.truncated and not episode.terminated
    assert episode.states.shape == (41, env.state_space.size) and episode.states.dtype == torch.float64
    assert episode.obs.shape == (41, 6) and episode.actions.shape == (40, 2)
    assert episode.evals[-1] < episode.evals[0]
    assert episode.mode == "sync" and episode.period == episode.timestep == env.timestep
    assert torch.equal(episode.plan_of, torch.arange(40)) and not episode.age_steps.any() and not episode.late.any()
    assert torch.allclose(episode.actions[7], towards(episode.states[7], episode.obs[7]))
    assert (episode.ages >= episode.plan_times).all() and (episode.times.diff() > 0).all()
    assert float(episode.plan_times.sum()) < episode.wall_seconds
    assert [progress.step for progress in seen] == list(range(1, 41))
    assert seen[-1].eval == episode.evals[-1] and seen[4].age == episode.ages[4]


def test_an_episode_replays_exactly(env: lw.Env) -> None:
    episode = control(env, towards, seed=5)
    env.set_state(episode.states[:1])
    for k, action in enumerate(episode.actions):
        env.step(action[None])
        assert torch.equal(env.get_state()[0], episode.states[k + 1])
        assert torch.equal(env.obs[0], episode.obs[k + 1])
        assert env.reward[0] == episode.rewards[k] and env.eval[0] == episode.evals[k]


def test_the_seed_decides(env: lw.Env) -> None:
    one, same, other = (control(env, towards, seed=seed, steps=3) for seed in (1, 1, 2))
    assert torch.equal(one.states, same.states) and not torch.equal(one.states, other.states)
    assert one.done_reason == 0 and one.steps == 3


def test_a_controller_is_told_of_shift_and_reset(env: lw.Env) -> None:
    planner = Planner(env)
    control(env, planner, seed=4, steps=4)
    assert planner.shifts == [0, 1, 1, 1] and planner.resets == [4]
    episode = control(env, planner, steps=3, reset=False)
    assert planner.shifts[4:] == [1, 1, 1] and planner.resets == [4]
    assert torch.allclose(episode.actions[:, 0], torch.tensor([0.04, 0.05, 0.06]))
    planner.shifts.clear()
    planner.timestep = 2 * env.timestep
    control(env, planner, steps=6)
    assert planner.shifts == [0, 1, 0, 1, 0, 1]


def test_what_does_not_fit(env: lw.Env, shared_env: Callable[..., lw.Env]) -> None:
    for other in (shared_env("point_mass"), shared_env("point_mass", nworld=2, autoreset=False)):
        with pytest.raises(ValueError, match="one world without automatic resets"):
            control(other, towards)
        with pytest.raises(ValueError, match="one world without automatic resets"):
            control_async(other, towards)
    with pytest.raises(ValueError, match="give steps, or a horizon"):
        control(shared_env("point_mass", autoreset=False, horizon=0), towards)
    with pytest.raises(ValueError, match="steps has to be a whole number"):
        control(env, towards, steps=0)
    with pytest.raises(ValueError, match="can't"):
        control(env, "towards")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a seed needs a reset"):
        control(env, towards, seed=1, reset=False)
    for period in (0.0, math.nan, math.inf, "fast"):
        with pytest.raises(ValueError, match="period has to be a positive number of seconds"):
            control_async(env, towards, period=period)  # type: ignore[arg-type]
    control(env, towards)
    with pytest.raises(ValueError, match="over before its first step"):
        control(env, towards, reset=False)


@pytest.mark.parametrize("run", [control, control_async])
def test_what_is_no_action(env: lw.Env, run: Callable[..., Trajectory]) -> None:
    with pytest.raises(ValueError, match=r"return an action of shape \(2,\), not a float32 tensor of shape \(1, 2\)"):
        run(env, lambda state, obs: torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"return an action of shape \(2,\), not NoneType None"):
        run(env, lambda state, obs: None)
    with pytest.raises(ValueError, match=r"wants 'y' to be nan at step 0: it has to be finite"):
        run(env, lambda state, obs: torch.tensor([0.0, math.nan]))
    bad = type("Bad", (), {"actions": torch.zeros(8, 3), "__call__": lambda *_: torch.zeros(2)})
    with pytest.raises(ValueError, match=r"have actions of shape \(horizon, 2\)"):
        run(env, bad())


# by the clock, without one: everything happens at the time that it should


class Clock:
    """Stands still but for who waits, and for those who say that they take time."""

    def __init__(self) -> None:
        self.time = 100.0

    def now(self) -> float:
        return self.time

    def wait_until(self, moment: float) -> None:
        self.time = max(self.time, moment)


class Plans:
    """Plans that take a given time of the clock, one after the other, from the newest state each."""

    def __init__(self, controller: Any, clock: Clock, seconds: float, first: tuple[torch.Tensor, torch.Tensor]) -> None:
        self.controller, self.clock, self.seconds = controller, clock, seconds
        actions = controller(*first, 0, 0)
        self.plans = [module._Plan(0, 0, clock.time - seconds, seconds, actions)]
        self.running: module._Plan | None = None
        self.waiting: tuple[int, torch.Tensor, torch.Tensor] | None = None

    def begin(self, now: float, step: int, state: torch.Tensor, obs: torch.Tensor) -> None:
        self.running = module._Plan(len(self.plans), step, now, self.seconds, self.controller(state, obs, 1, step))

    def newest(self) -> module._Plan:
        while self.running is not None and (end := self.running.begun + self.seconds) <= self.clock.time + 1e-9:
            self.plans.append(self.running)
            self.running = None
            if self.waiting is not None:
                self.begin(end, *self.waiting)
                self.waiting = None
        return self.plans[-1]

    def publish(self, *job: Any) -> None:
        self.waiting = job  # type: ignore[assignment]
        if self.running is None:
            self.begin(self.clock.time, *job)
            self.waiting = None


def clocked(
    env: lw.Env,
    *,
    seconds: float,
    steps: int,
    horizon: int = 8,
    busy: dict[int, float] | None = None,
    seen: list[ControlProgress] | None = None,
) -> Trajectory:
    """A run on the clock above, with a period of one second."""
    env.rand_reset(0)
    clock = Clock()
    controller = CheckedController(Planner(env, horizon), env)
    recording = module._Recording(env, "async", 1.0, controller, None)
    with torch.no_grad():
        plans = Plans(controller, clock, seconds, (recording.states[0], recording.obs[0]))

        def on_step(progress: ControlProgress) -> None:
            if seen is not None:
                seen.append(progress)
            clock.time += (busy or {}).get(progress.step - 1, 0.0)

        start = clock.now()
        wall = module._run_plant(env, controller, plans, clock, recording, start, steps, on_step)  # type: ignore[arg-type]
    for plan in plans.plans:
        recording.plan(plan, start, (math.nan, math.nan))
    return recording.trajectory(wall, 0)


def hundredths(values: torch.Tensor) -> list[int]:
    return (100 * values).round().int().tolist()


def test_a_fast_planner_is_a_step_behind(env: lw.Env) -> None:
    episode = clocked(env, seconds=0.3, steps=6)
    assert episode.times.tolist() == pytest.approx([0, 1, 2, 3, 4, 5])
    assert episode.age_steps.tolist() == [0, 1, 1, 1, 1, 1]
    assert episode.ages.tolist() == pytest.approx([0, 1, 1, 1, 1, 1])
    assert hundredths(episode.actions[:, 0]) == [0, 0, 1, 2, 3, 4]  # the state that it was planned from
    assert hundredths(episode.actions[:, 1]) == [0, 1, 1, 1, 1, 1]  # the second action of each plan
    assert episode.wall_seconds == pytest.approx(6)
    report = control_report(episode)
    assert (report.misses, report.late_ticks, report.age_steps_max, report.deadline_ms) == (0, 0, 1, 1000)
    assert report.tick_jitter_ms == pytest.approx(0, abs=1e-6)
    assert report.real_time_factor == pytest.approx(env.timestep)


def test_a_slow_planner_misses_deadlines(env: lw.Env) -> None:
    episode = clocked(env, seconds=2.5, steps=9)
    # the plan from state 1 is there at 3.5; the next, from the newest state then, is begun at 3.5 and there at 6
    assert episode.plan_of.tolist() == [0, 0, 0, 0, 1, 1, 2, 2, 2]
    assert episode.plan_steps[:3].tolist() == [0, 1, 3]
    assert episode.ages.tolist() == pytest.approx([0, 1, 2, 3, 3, 4, 3, 4, 5])
    assert hundredths(episode.actions[:, 1]) == [0, 1, 2, 3, 3, 4, 3, 4, 5]
    report = control_report(episode)
    assert report.misses == report.plans == len(episode.plan_times) - 1 and report.miss_share == 1
    assert report.age_steps_max == 5 and report.age_max_ms == pytest.approx(5000)
    assert control_report(episode, rate=0.1).misses == 0


def test_a_plan_that_is_used_up_holds_its_last_action(env: lw.Env) -> None:
    assert hundredths(clocked(env, seconds=100, steps=6, horizon=3).actions[:, 1]) == [0, 1, 2, 2, 2, 2]
    assert hundredths(clocked(env, seconds=100, steps=4, horizon=1).actions[:, 1]) == [0, 0, 0, 0]


def test_a_plant_that_overruns_keeps_its_schedule(env: lw.Env) -> None:
    episode = clocked(env, seconds=0.1, steps=6, busy={1: 2.25})
    assert episode.times.tolist() == pytest.approx([0, 1, 3.25, 3.25, 4, 5])
    assert episode.late.tolist() == [False, False, True, True, False, False]
    report = control_report(episode)
    assert report.misses == 0 and report.late_ticks == 2 and report.tick_delay_max_ms == pytest.approx(1250)
    assert report.tick_jitter_ms == pytest.approx(np.std([0, 0, 1250, 250, 0, 0], ddof=1))


def test_which_action_is_for_now(env: lw.Env) -> None:
    planner = Planner(env)
    planner.timestep = 2 * env.timestep
    coarse = CheckedController(planner, env)
    assert [coarse.index(steps, 3) for steps in range(8)] == [0, 1, 1, 2, 2, 2, 2, 2]
    planner.timestep = env.timestep / 2
    fine = CheckedController(planner, env)
    assert [fine.index(steps, 8) for steps in range(6)] == [0, 2, 4, 6, 7, 7]


# by the clock, with a thread: slow periods, and much slower controllers


def planner_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "lyceum_warp planner"]


def test_a_planner_in_a_thread(env: lw.Env) -> None:
    planner, interval = Planner(env, seconds=0.12), sys.getswitchinterval()
    episode = control_async(env, planner, period=0.04, seconds=0.4, seed=6)
    assert episode.steps == 10 and episode.mode == "async" and episode.period == 0.04
    assert planner.resets == [6, 6]
    assert planner.shifts[:3] == [0, 0, 0]
    assert planner.shifts[3:] == episode.plan_steps.diff().tolist()
    # whatever the machine was busy with: each action is what its plan has for its step
    assert hundredths(episode.actions[:, 0]) == episode.plan_steps[episode.plan_of].tolist()
    assert hundredths(episode.actions[:, 1]) == episode.age_steps.clamp(max=7).tolist()
    assert episode.plan_starts[0] < 0 and episode.ages[0] == 0 and (episode.plan_starts[1:] > 0).all()
    report = control_report(episode)
    assert report.misses == report.plans > 0 and report.age_steps_max > 1 and report.age_max_ms > 80
    assert report.plan_max_ms is not None and report.plan_max_ms >= 120
    assert episode.wall_seconds >= 0.4
    assert not planner_threads() and sys.getswitchinterval() == interval
    for k, action in enumerate(episode.actions):
        env.set_state(episode.states[k : k + 1])
        env.step(action[None])
        assert torch.equal(env.get_state()[0], episode.states[k + 1])


def test_a_policy_in_a_thread_is_in_time(env: lw.Env) -> None:
    episode = control_async(env, towards, period=0.03, steps=12, seed=6)
    assert episode.age_steps[0] == 0 and (episode.age_steps[1:] >= 1).all()
    for k in range(12):
        made_from = int(episode.plan_steps[episode.plan_of[k]])
        assert torch.allclose(episode.actions[k], towards(episode.states[made_from], episode.obs[made_from]))


def test_mppi_in_a_thread_plans_as_it_does_alone(env: lw.Env) -> None:
    mppi = pytest.importorskip("lyceum_warp.algos.mppi").MPPI("point_mass", horizon=6, samples=4, nthread=1)
    episode = control_async(env, mppi, period=0.004, seed=5)
    mppi.reset(5)
    plans, last = [], 0
    for step in episode.plan_steps.tolist():
        mppi(episode.states[step], shift=step - last)
        plans.append(mppi.actions.clone())
        last = step
    for k, (plan, age) in enumerate(zip(episode.plan_of, episode.age_steps, strict=True)):
        assert torch.equal(episode.actions[k], plans[plan][min(int(age), 5)])
    assert torch.equal(control(env, mppi, seed=5, steps=4).states, control(env, mppi, seed=5, steps=4).states)


def test_an_episode_ends_by_itself_when_it_is_over(env: lw.Env) -> None:
    episode = control_async(env, towards, period=0.001, steps=1000)
    assert episode.steps == 40 and episode.truncated


def test_a_policy_alone_is_no_controller(env: lw.Env) -> None:
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    with pytest.raises(ValueError, match=r"GaussianPolicy takes one argument: give lambda state, obs: policy\(obs\)"):
        control(env, policy, steps=2)
    assert control(env, lambda state, obs: policy(obs), steps=2).steps == 2


def test_an_error_of_the_controller_is_raised(env: lw.Env) -> None:
    calls = []

    def failing(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        calls.append(threading.current_thread())
        if len(calls) == fails_at:
            raise ZeroDivisionError("the controller's own")
        return torch.zeros(2)

    for fails_at in (1, 3, 5):
        calls.clear()
        with pytest.raises(ZeroDivisionError, match="the controller's own"):
            control_async(env, failing, period=0.01)
        assert len(calls) == fails_at and not planner_threads()


@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_error_of_the_plant_ends_the_thread(env: lw.Env, kind: type[BaseException]) -> None:
    def stop(progress: ControlProgress) -> None:
        if progress.step == 3:
            raise kind

    interval = sys.getswitchinterval()
    with pytest.raises(kind):
        control_async(env, Planner(env, seconds=0.02), period=0.01, on_step=stop)
    assert not planner_threads() and sys.getswitchinterval() == interval


def test_the_real_clock_waits_long_enough() -> None:
    clock = module._Clock()
    for wait in (-1.0, 0.0, 0.0002, 0.004):
        moment = clock.now() + wait
        clock.wait_until(moment)
        assert clock.now() >= moment
