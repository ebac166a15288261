import math
from pathlib import Path

import pytest
import torch
from toy_controllers import SamplingPlanner, StepPlanner

import lyceum_warp as lw
from lyceum_warp.controllers import CheckedController, Trajectory, control


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


def test_controller_that_is_not_callable_raises_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match=r"must be callable with \(state, obs\), not str 'towards': pass a function"):
        control(env, "towards")  # type: ignore[arg-type]


def test_function_with_one_argument_raises_an_error(env: lw.Env) -> None:
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    with pytest.raises(ValueError, match=r"function takes one argument: pass lambda state, obs: policy\(obs\)"):
        control(env, lambda obs: policy(obs), steps=2)  # type: ignore[misc, arg-type]
    assert control(env, lambda state, obs: policy(obs), steps=2).steps == 2


def test_a_planner_cannot_control_its_own_environment() -> None:
    plan = lw.MPPI("point_mass", horizon=4, samples=1)
    with pytest.raises(ValueError, match="plans in the environment that it controls.*: control another environment"):
        control(plan.env, plan, steps=4)


@pytest.mark.parametrize("timestep, message", [
    ("fast", "the timestep of a controller must be a positive number of seconds"),
    (0.03, "controller's step is 0.03 s and the plant's step is 0.02 s, but one must be a multiple"),
])  # fmt: skip
def test_invalid_time_step_raises_an_error(env: lw.Env, timestep: object, message: str) -> None:
    planner = StepPlanner(env)
    planner.timestep = timestep  # type: ignore[assignment]
    with pytest.raises(ValueError, match=message):
        CheckedController(planner, env)


def test_invalid_action_or_plan_raises_an_error(env: lw.Env) -> None:
    bad = type("Bad", (), {"actions": torch.zeros(8, 3), "__call__": lambda *_: torch.zeros(2)})
    for controller, message in (
        (lambda *_: torch.zeros(1, 2), r"return an action of shape \(2,\), not a float32 tensor of shape \(1, 2\)"),
        (lambda *_: None, r"must return an action of shape \(2,\), not NoneType None"),
        (bad(), r"must have actions of shape \(horizon, 2\), not a float32 tensor"),
        (lambda *_: torch.tensor([0.0, math.nan]), "the controller's action 'y' at step 0 must be finite, not nan"),
    ):
        with pytest.raises(ValueError, match=message):
            control(env, controller)


def test_plan_is_resampled_to_the_time_step_of_the_plant(env: lw.Env) -> None:
    plan = torch.tensor([[0.0, 1.0], [1.0, 3.0], [2.0, 9.0]])

    def applied(timestep: float, steps: int, **words: str) -> list[float]:
        planner = StepPlanner(env)
        planner.timestep = timestep
        vars(planner).update(words)
        checked = CheckedController(planner, env)
        return [round(checked.action(plan, step)[0].item(), 6) for step in range(steps)]

    assert applied(env.timestep, 4) == applied(env.timestep, 4, between="linear") == [0, 1, 2, 2]
    assert applied(2 * env.timestep, 7) == [0, 0, 1, 1, 2, 2, 2]
    assert applied(2 * env.timestep, 7, between="linear") == [0, 0.5, 1, 1.5, 2, 2, 2]
    assert applied(env.timestep / 2, 3) == [0, 2, 2]


def test_actions_of_mppi_are_interpolated_to_the_time_step_of_the_plant(env: lw.Env) -> None:
    plan = lw.MPPI("point_mass", frame_skip=2 * env.task.frame_skip, horizon=4, samples=8, between="linear")
    actions = control(env, plan, seed=1, steps=6, replan_every=6).actions
    torch.testing.assert_close(actions[::2], plan.actions[:3], rtol=0, atol=0)
    torch.testing.assert_close(actions[1:5:2], (plan.actions[:2] + plan.actions[1:3]) / 2)


def test_trajectory_describes_the_controller_by_json_values(env: lw.Env, tmp_path: Path) -> None:
    def zeros(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(2)

    episode = control(env, zeros, steps=1)
    assert episode.controller == {"name": "zeros"} and episode.seed is None
    assert Trajectory.load(episode.save(tmp_path / "a.npz")).seed is None
    episode = control(env, SamplingPlanner(0), steps=1)
    assert episode.controller["name"] == "SamplingPlanner" and episode.controller["smoothing"] == [1.0, 0.0]
    assert isinstance(episode.controller["odd"], str)
    assert Trajectory.load(episode.save(tmp_path / "a.npz")).controller == episode.controller
