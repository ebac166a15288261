import time
from collections.abc import Callable

import pytest
import torch
from conftest import SharedEnv
from toy_controllers import SamplingPlanner, StepPlanner, hundredths, towards

import lyceum_warp as lw
from lyceum_warp.controllers import ControlProgress, Trajectory, control, control_async


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


def test_control_returns_the_complete_episode(env: lw.Env) -> None:
    episode = control(env, towards, seed=3)
    assert episode.steps == 40 and episode.truncated and not episode.terminated
    assert episode.states.shape == (41, env.state_space.size) and episode.states.dtype == torch.float64
    assert episode.obs.shape == (41, 6) and episode.actions.shape == (40, 2)
    assert episode.evals[-1] < episode.evals[0]
    assert episode.mode == "sync" and episode.period == episode.timestep == env.timestep
    assert torch.equal(episode.plan_of, torch.arange(40)) and not episode.age_steps.any() and not episode.late.any()
    assert torch.allclose(episode.actions[7], towards(episode.states[7], episode.obs[7]))
    assert (episode.ages >= episode.plan_times).all() and (episode.times.diff() > 0).all()
    assert float(episode.plan_times.sum()) < episode.wall_seconds


def test_first_state_and_actions_replay_the_episode_exactly(env: lw.Env) -> None:
    episode = control(env, towards, seed=5)
    env.set_state(episode.states[:1])
    for k, action in enumerate(episode.actions):
        env.step(action[None])
        assert torch.equal(env.get_state()[0], episode.states[k + 1])
        assert torch.equal(env.obs[0], episode.obs[k + 1])
        assert env.reward[0] == episode.rewards[k] and env.eval[0] == episode.evals[k]


def test_plan_is_shifted_by_one_step_except_after_a_reset(env: lw.Env) -> None:
    planner = StepPlanner(env)
    assert control(env, planner, seed=4, steps=4).done_reason == 0
    assert planner.shifts == [0, 1, 1, 1] and planner.resets == [4]
    episode = control(env, planner, steps=3, reset=False)
    assert planner.shifts[4:] == [1, 1, 1] and planner.resets == [4]
    assert torch.allclose(episode.actions[:, 0], torch.tensor([0.04, 0.05, 0.06]))


@pytest.mark.parametrize("ratio, shifts", [(2.0, [0, 0, 1, 0, 1, 0, 1]), (0.25, [0, 4, 4, 4, 4, 4, 4])])
def test_continued_episode_shifts_plans_like_an_uninterrupted_one(env: lw.Env, ratio: float, shifts: list[int]) -> None:
    planner = StepPlanner(env)
    planner.timestep = ratio * env.timestep
    control(env, planner, steps=3)
    control(env, planner, steps=4, reset=False)
    assert planner.shifts == shifts


def test_actions_of_the_plan_are_applied_between_replans(env: lw.Env) -> None:
    planner = StepPlanner(env)
    episode = control(env, planner, steps=8, replan_every=3)
    assert planner.shifts == [0, 3, 3] and episode.plan_steps.tolist() == [0, 3, 6]
    assert hundredths(episode.actions[:, 0]) == [0, 0, 0, 3, 3, 3, 6, 6]
    assert hundredths(episode.actions[:, 1]) == [0, 1, 2, 0, 1, 2, 0, 1]
    assert episode.age_steps.tolist() == [0, 1, 2, 0, 1, 2, 0, 1] and (episode.ages.diff()[:2] > 0).all()
    assert lw.control_report(episode).plans == 2
    control(env, planner, steps=4, reset=False, replan_every=3)
    assert planner.shifts[3:] == [2, 1], "the second call plans at step 8, its first, and at step 9"


def test_replanning_interval_counts_steps_of_the_plant(env: lw.Env) -> None:
    planner = StepPlanner(env)
    planner.timestep = 2 * env.timestep
    episode = control(env, planner, steps=8, replan_every=4)
    assert planner.shifts == [0, 2]
    assert hundredths(episode.actions[:, 1]) == [0, 0, 1, 1, 0, 0, 1, 1]


def test_replanning_interval_longer_than_the_plan_raises_an_error(env: lw.Env) -> None:
    for every, controller, message in (
        (0, StepPlanner(env), "replan_every must be a whole number from 1"),
        (9, StepPlanner(env), "needs a plan of 9 actions, but the controller has a plan of 8 actions: plan more often"),
        (2, towards, "replan_every=2 needs a plan of 2 actions, but the controller has no plan"),
    ):
        with pytest.raises(ValueError, match=message):
            control(env, controller, steps=20, replan_every=every)


# what both loops share

Run = Callable[..., Trajectory]
BOTH = pytest.mark.parametrize("run", [control, control_async])


def test_control_of_unsuitable_environments_raises_an_error(shared_env: SharedEnv) -> None:
    for options, message in (
        ({}, "one world without automatic resets, not nworld=1, autoreset=True"),
        ({"nworld": 2, "autoreset": False}, "one world without automatic resets, not nworld=2, autoreset=False"),
        ({"autoreset": False, "horizon": 0}, "pass steps, or give make"),
    ):
        with pytest.raises(ValueError, match=message):
            control(shared_env("point_mass", **options), towards)


def test_control_with_invalid_arguments_raises_an_error(env: lw.Env) -> None:
    control(env, towards)
    for arguments, message in (
        ({"steps": 0}, "steps must be a whole number from 1 to .*, not 0"),
        ({"seed": 1, "reset": False}, "seed=1 has no effect with reset=False"),
        ({"reset": False}, "current episode is already over: reset the environment"),
    ):
        with pytest.raises(ValueError, match=message):
            control(env, towards, **arguments)


@BOTH
def test_progress_includes_the_step_and_counts_the_plans(
    run: Run, env: lw.Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = env.step

    def slow() -> None:
        time.sleep(0.01)
        step()

    monkeypatch.setattr(env, "step", slow)
    seen: list[ControlProgress] = []
    episode = run(env, SamplingPlanner(0), steps=6, on_step=seen.append)
    assert seen[0].time >= 0.01
    assert all(now.step / now.time <= 100 for now in seen)
    assert [now.plans - 1 for now in seen] == episode.plan_of.tolist()
    assert [now.step for now in seen] == list(range(1, 7))
    assert seen[-1].eval == episode.evals[-1] and seen[4].age == episode.ages[4]


@BOTH
def test_abort_callback_receives_the_complete_steps(run: Run, env: lw.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, step = control(env, SamplingPlanner(0), seed=3), env.step

    def stop() -> None:
        if env.episode_step.item() == 5:
            raise KeyboardInterrupt
        step()

    monkeypatch.setattr(env, "step", stop)
    parts: list[Trajectory] = []
    with pytest.raises(KeyboardInterrupt):
        run(env, SamplingPlanner(0), seed=3, on_abort=parts.append)
    (part,) = parts
    assert part.steps == 5 and part.done_reason == 0 and part.seed == 3
    assert torch.equal(part.states, whole.states[:6])
    assert len(part.times) == len(part.plan_of) == len(part.late) == 5 and part.wall_seconds > part.times[-1]


def test_abort_callback_is_not_called_before_the_first_step(env: lw.Env) -> None:
    def fails(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        control(env, fails, on_abort=lambda part: pytest.fail("on_abort was called before the first step"))
