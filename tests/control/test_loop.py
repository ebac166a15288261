"""The synchronous loop."""

import pytest
import torch
from toy_controllers import StepPlanner, towards

import lyceum_warp as lw
from lyceum_warp.control.episode_collector import ControlProgress
from lyceum_warp.control.loop import control


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


def test_control_returns_the_whole_episode(env: lw.Env) -> None:
    episode = control(env, towards, seed=3)
    assert episode.steps == 40 and episode.truncated and not episode.terminated
    assert episode.states.shape == (41, env.state_space.size) and episode.states.dtype == torch.float64
    assert episode.obs.shape == (41, 6) and episode.actions.shape == (40, 2)
    assert episode.evals[-1] < episode.evals[0]
    assert episode.mode == "sync" and episode.period == episode.timestep == env.timestep


def test_each_action_comes_from_a_plan_of_its_own_state(env: lw.Env) -> None:
    episode = control(env, towards, seed=3)
    assert torch.equal(episode.plan_of, torch.arange(40)) and not episode.age_steps.any() and not episode.late.any()
    assert torch.allclose(episode.actions[7], towards(episode.states[7], episode.obs[7]))
    assert (episode.ages >= episode.plan_times).all() and (episode.times.diff() > 0).all()
    assert float(episode.plan_times.sum()) < episode.wall_seconds


def test_on_step_is_called_after_each_step(env: lw.Env) -> None:
    seen: list[ControlProgress] = []
    episode = control(env, towards, seed=3, on_step=seen.append)
    assert [progress.step for progress in seen] == list(range(1, 41))
    assert seen[-1].eval == episode.evals[-1] and seen[4].age == episode.ages[4]


def test_first_state_and_actions_replay_the_episode_exactly(env: lw.Env) -> None:
    episode = control(env, towards, seed=5)
    env.set_state(episode.states[:1])
    for k, action in enumerate(episode.actions):
        env.step(action[None])
        assert torch.equal(env.get_state()[0], episode.states[k + 1])
        assert torch.equal(env.obs[0], episode.obs[k + 1])
        assert env.reward[0] == episode.rewards[k] and env.eval[0] == episode.evals[k]


def test_the_seed_determines_the_episode(env: lw.Env) -> None:
    one, same, other = (control(env, towards, seed=seed, steps=3) for seed in (1, 1, 2))
    assert torch.equal(one.states, same.states) and not torch.equal(one.states, other.states)


def test_steps_stop_the_episode_early(env: lw.Env) -> None:
    episode = control(env, towards, steps=3)
    assert episode.done_reason == 0 and episode.steps == 3


def test_a_reset_calls_the_controllers_reset_and_starts_with_shift_zero(env: lw.Env) -> None:
    planner = StepPlanner(env)
    control(env, planner, seed=4, steps=4)
    assert planner.shifts == [0, 1, 1, 1] and planner.resets == [4]


def test_without_a_reset_the_episode_continues_with_shift_one(env: lw.Env) -> None:
    planner = StepPlanner(env)
    control(env, planner, seed=4, steps=4)
    episode = control(env, planner, steps=3, reset=False)
    assert planner.shifts[4:] == [1, 1, 1] and planner.resets == [4]
    assert torch.allclose(episode.actions[:, 0], torch.tensor([0.04, 0.05, 0.06]))


def test_shift_counts_steps_of_the_controller(env: lw.Env) -> None:
    planner = StepPlanner(env)
    planner.timestep = 2 * env.timestep
    control(env, planner, steps=6)
    assert planner.shifts == [0, 1, 0, 1, 0, 1]
