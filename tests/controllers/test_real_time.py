import math
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from toy_controllers import SamplingPlanner, StepPlanner, hundredths, simulated_run, towards

import lyceum_warp as lw
from lyceum_warp.controllers import ControlProgress, control_async, control_report


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


def test_actions_are_one_step_old_if_plans_take_less_than_a_period(env: lw.Env) -> None:
    episode = simulated_run(env, seconds=0.3, steps=6)
    assert episode.times.tolist() == pytest.approx([0, 1, 2, 3, 4, 5])
    assert episode.age_steps.tolist() == [0, 1, 1, 1, 1, 1]
    assert episode.ages.tolist() == pytest.approx([0, 1, 1, 1, 1, 1])
    assert hundredths(episode.actions[:, 0]) == [0, 0, 1, 2, 3, 4]
    assert hundredths(episode.actions[:, 1]) == [0, 1, 1, 1, 1, 1]
    assert episode.wall_seconds == pytest.approx(6)
    report = control_report(episode)
    assert (report.misses, report.late_ticks, report.age_steps_max, report.deadline_ms) == (0, 0, 1, 1000)
    assert report.tick_jitter_ms == pytest.approx(0, abs=1e-6)
    assert report.real_time_factor == pytest.approx(env.timestep)


def test_a_slow_planner_misses_its_deadlines(env: lw.Env) -> None:
    episode = simulated_run(env, seconds=2.5, steps=9)
    assert episode.plan_of.tolist() == [0, 0, 0, 0, 1, 1, 2, 2, 2]
    assert episode.plan_steps[:3].tolist() == [0, 1, 3]
    assert episode.ages.tolist() == pytest.approx([0, 1, 2, 3, 3, 4, 3, 4, 5])
    assert hundredths(episode.actions[:, 1]) == [0, 1, 2, 3, 3, 4, 3, 4, 5]
    report = control_report(episode)
    assert report.misses == report.plans == len(episode.plan_times) - 1 and report.miss_share == 1
    assert report.age_steps_max == 5 and report.age_max_ms == pytest.approx(5000)
    assert control_report(episode, rate=0.1).misses == 0


def test_the_last_action_of_a_plan_is_applied_until_the_next_plan(env: lw.Env) -> None:
    assert hundredths(simulated_run(env, seconds=100, steps=6, horizon=3).actions[:, 1]) == [0, 1, 2, 2, 2, 2]
    assert hundredths(simulated_run(env, seconds=100, steps=4, horizon=1).actions[:, 1]) == [0, 0, 0, 0]


def test_slow_step_does_not_delay_later_steps(env: lw.Env) -> None:
    episode = simulated_run(env, seconds=0.1, steps=6, busy={1: 2.25})
    assert episode.times.tolist() == pytest.approx([0, 1, 3.25, 3.25, 4, 5])
    assert episode.late.tolist() == [False, False, True, True, False, False]
    report = control_report(episode)
    assert report.misses == 0 and report.late_ticks == 2 and report.tick_delay_max_ms == pytest.approx(1250)
    assert report.tick_jitter_ms == pytest.approx(np.std([0, 0, 1250, 250, 0, 0], ddof=1))


def predicted_and_measured(env: lw.Env) -> tuple[torch.Tensor, torch.Tensor]:
    """Run a controller that gets predicted states. Return the predicted states and the measured states."""
    planned = []

    def controller(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        planned.append(torch.cat([state, obs.double()]))
        return 0.1 * obs[: env.action_space.size].clamp(-1, 1)

    episode = control_async(env, controller, period=0.01, steps=12, seed=3, predict=True)
    measured = torch.cat([episode.states, episode.obs.double()], dim=1)
    first, *others = planned[2:]  # the warm-up makes two plans
    assert len(others) == len(episode.plan_steps) - 1 > 0
    torch.testing.assert_close(first, measured[0])
    assert episode.age_steps[0] == 0 and (episode.age_steps[1:] >= 1).all()
    return torch.stack(others), measured[episode.plan_steps[1:] + 1]


def test_predicted_and_measured_states_differ_only_in_the_random_stream(env: lw.Env) -> None:
    predicted, measured = predicted_and_measured(env)
    key = env.state_space.parts["key"]
    assert (predicted[:, key] != measured[:, key]).all()
    predicted[:, key] = measured[:, key]
    torch.testing.assert_close(predicted, measured)


def test_predicted_states_do_not_contain_the_pushes_of_events() -> None:
    times = [0.015 * k for k in range(1, 13)]
    env = lw.make("humanoid_stand", autoreset=False, push_times=times, push_impulse=[10.0, 10.0])
    predicted, measured = predicted_and_measured(env)
    x_and_y = slice(start := env.state_space.parts["qvel"].start, start + 2)
    change = (measured - predicted)[:, x_and_y].norm(dim=1)
    torch.testing.assert_close(change, torch.full_like(change, 10.0 / env.model.body_mass.sum()), rtol=1e-3, atol=0.0)


def planner_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "lyceum_warp planner"]


def test_a_slow_planner_in_a_thread_plans_while_the_plant_steps(env: lw.Env) -> None:
    planner, interval = StepPlanner(env, seconds=0.12), sys.getswitchinterval()
    episode = control_async(env, planner, period=0.04, steps=10, seed=6)
    assert episode.steps == 10 and episode.mode == "async" and episode.period == 0.04
    assert planner.resets == [6, 6]
    assert planner.shifts[:3] == [0, 0, 0]
    assert planner.shifts[3:] == episode.plan_steps.diff().tolist()
    assert hundredths(episode.actions[:, 0]) == episode.plan_steps[episode.plan_of].tolist()
    assert hundredths(episode.actions[:, 1]) == episode.age_steps.clamp(max=7).tolist()
    assert episode.plan_starts[0] < 0 and episode.ages[0] == 0 and (episode.plan_starts[1:] > 0).all()
    report = control_report(episode)
    assert report.misses == report.plans > 0 and report.age_steps_max > 1 and report.age_max_ms > 80
    assert report.plan_max_ms is not None and report.plan_max_ms >= 120
    assert episode.wall_seconds >= 0.4
    assert not planner_threads() and sys.getswitchinterval() == interval


def test_mppi_gives_the_same_plans_in_a_thread(env: lw.Env) -> None:
    mppi = lw.MPPI("point_mass", horizon=6, samples=4, nthread=1)
    episode = control_async(env, mppi, period=0.004, seed=5)
    mppi.reset(5)
    plans, last = [], 0
    for step in episode.plan_steps.tolist():
        mppi(episode.states[step], shift=step - last)
        plans.append(mppi.actions.clone())
        last = step
    for k, (plan, age) in enumerate(zip(episode.plan_of, episode.age_steps, strict=True)):
        assert torch.equal(episode.actions[k], plans[plan][min(int(age), 5)])


def test_invalid_period_raises_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match="period must be a positive number of seconds, not nan"):
        control_async(env, towards, period=math.nan)


@pytest.mark.parametrize("fails_at", [1, 3, 5])
def test_an_exception_of_the_controller_is_raised(env: lw.Env, fails_at: int) -> None:
    calls = []

    def failing(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        calls.append(threading.current_thread())
        if len(calls) == fails_at:
            raise ZeroDivisionError("the controller's own")
        return torch.zeros(2)

    with pytest.raises(ZeroDivisionError, match="the controller's own"):
        control_async(env, failing, period=0.01)
    assert len(calls) == fails_at and not planner_threads()


def test_an_exception_of_the_plant_does_not_wait_for_an_unfinished_plan(env: lw.Env) -> None:
    released = threading.Event()

    class Slow(SamplingPlanner):
        def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> object:
            if state[env.state_space.parts["step"]] > 0:
                released.wait(20)
            return None

    def stop(progress: ControlProgress) -> None:
        if progress.step == 4:
            raised.append(time.perf_counter())
            raise KeyboardInterrupt

    raised, interval = [], sys.getswitchinterval()
    with pytest.raises(KeyboardInterrupt):
        control_async(env, Slow(0), period=0.01, on_step=stop)
    assert time.perf_counter() - raised[0] < 5 and sys.getswitchinterval() == interval
    released.set()
    for thread in planner_threads():
        thread.join(20)
    assert not planner_threads()


@pytest.mark.long
def test_program_exits_normally_while_mppi_is_planning() -> None:
    program = """
import threading, time, torch, lyceum_warp as lw
plan = lw.MPPI("point_mass", horizon=20, samples=4000, iterations=300, nthread=1)
env = lw.make("point_mass", autoreset=False)
def stop(progress):
    if progress.step == 3:
        raise KeyboardInterrupt
class Late:
    timestep = plan.timestep
    def __call__(self, state, obs):
        return torch.zeros(2) if state[env.state_space.parts["step"]] == 0 else plan(state)
try:
    lw.control_async(env, Late(), on_step=stop)
except KeyboardInterrupt:
    print("ended", sum(thread.name == "lyceum_warp planner" for thread in threading.enumerate()))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout == "ended 1\n", done.stderr
