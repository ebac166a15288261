from typing import Any

import pytest
import torch
import warp as wp
from form_tasks import Pushed
from varied_task import Varied

import lyceum_warp as lw
from lyceum_warp import Row


@wp.func
def first_squared(obs: Row[float]) -> float:
    return 3.0 * obs[0] * obs[0]


def fitted_value() -> lw.ValueFunction:
    value = lw.ValueFunction(6, time_orders=2)
    for weights in value.parameters():
        torch.nn.init.normal_(weights, generator=torch.Generator().manual_seed(len(weights)))
    return value


CASES: dict[str, dict[str, Any]] = {
    "mppi": dict(task="point_mass"),
    "without the plan": dict(task="point_mass", include_plan=False, smoothing=(0.5, 0.3, 0.2), iterations=2),
    "covariance": dict(task="point_mass", noise=[[0.3, 0.2], [0.2, 0.25]], fill="repeat"),
    "knots": dict(task="point_mass", knots=3, spline="linear"),
    "cem": dict(task="point_mass", update="cem", elites=3, noise=0.4, min_noise=0.05),
    "cem with knots": dict(
        task="point_mass", update="cem", elites=3, knots=3, spline="cubic", smoothing=(0.5, 0.3, 0.2)
    ),
    "predictive sampling": dict(task="point_mass", update="predictive_sampling", iterations=2),
    "models": dict(task=Varied, models=2, risk="worst", knots=2),
    "models with a value": dict(task=Varied, models=3, value=first_squared),
    "fitted value": dict(task="point_mass", value=fitted_value()),
    "control of the task": dict(task=Pushed, noise=0.5),
    "stop": dict(task="hopper", termination="stop"),
    "frame skip": dict(task="reach", frame_skip=2),
}
ON_WARP = ("mppi", "cem with knots", "models", "control of the task")
BUFFERS = ("actions", "nominal", "knot_actions", "standard_noise", "sampled", "adapted_noise")  # plants: axis 1
FIRST = ("returns", "weights", "model_returns")


def states_of(task: Any, count: int) -> torch.Tensor:
    """Make states at different steps, on which a fitted value function depends."""
    env = lw.make(task, nworld=count, autoreset=False, seed=3)
    states = env.get_state()
    states[:, env.state_space.parts["step"].start] = 30.0 * torch.arange(count)
    return states


@pytest.mark.quick(*(f"{case}-mujoco" for case in CASES))
@pytest.mark.parametrize("case, engine", [*((c, "mujoco") for c in CASES), *((c, "warp") for c in ON_WARP)])
def test_planner_for_several_plants_equals_separate_planners(case: str, engine: str) -> None:
    settings = dict(horizon=6, samples=8, temperature=0.5, engine=engine) | CASES[case]
    states = states_of(settings["task"], 3)
    together = lw.MPPI(**settings, seed=5, plants=3)
    alone = [lw.MPPI(**settings, seed=5 + i) for i in range(3)]
    for plan in alone:
        for name, rows in plan.model_fields.items():
            rows.copy_(together.model_fields[name])
    for shift in (1, 2):
        actions = together(states, shift=shift)
        assert actions.shape == (3, together.env.action_space.size)
        for i, plan in enumerate(alone):
            torch.testing.assert_close(actions[i], plan(states[i], shift=shift))
            for name in BUFFERS:
                if (wanted := getattr(plan, name)) is not None:
                    torch.testing.assert_close(getattr(together, name)[:, i], wanted)
            for name in FIRST:
                torch.testing.assert_close(getattr(together, name)[i], getattr(plan, name))
            for name, value in plan.summary.items():
                assert together.summary[name][i].item() == pytest.approx(value, rel=1e-5)


def test_reset_with_a_mask_restarts_only_the_selected_plants() -> None:
    plan = lw.MPPI("point_mass", horizon=5, samples=6, update="cem", elites=2, knots=2, plants=3, seed=1)
    states = states_of("point_mass", 3)
    first = plan(states)
    plan(states)
    second = plan.actions.clone()
    plan.reset(where=torch.tensor([False, True, False]))
    assert torch.equal(plan.actions[:, [0, 2]], second[:, [0, 2]]) and not plan.actions[:, 1].any()
    third = plan(states)
    torch.testing.assert_close(third[1], first[1])
    assert not torch.allclose(third[0], first[0])
    plan.reset([4, 9, 1])
    assert not torch.allclose(*plan(states)[:2])
    plan.reset(9, where=torch.tensor([False, False, True]))
    assert plan.seeds == [4, 9, 11]
    torch.testing.assert_close(plan(states)[2], lw.MPPI("point_mass", horizon=5, samples=6, update="cem", elites=2,
                                                        knots=2, seed=11)(states[2]))  # fmt: skip


@pytest.mark.parametrize("update", ["mppi", "cem", "predictive_sampling"])
def test_plan_of_a_plant_does_not_change_if_all_its_samples_fail(update: str) -> None:
    def second_fails(obs: torch.Tensor) -> torch.Tensor:
        plant = torch.arange(len(obs)) // 5
        return torch.where(plant == 1, torch.nan, obs[:, 0])

    settings: dict[str, Any] = dict(task="point_mass", horizon=4, samples=5, update=update, noise=0.3)
    states = states_of("point_mass", 3)
    plan = lw.MPPI(**settings, value=second_fails, seed=7, plants=3)
    plan.actions[:, 1] = 0.125
    actions = plan(states, shift=0)
    assert (plan.actions[:, 1] == 0.125).all() and not plan.weights[1].any()
    assert plan.summary["failed_samples"].tolist() == [0, 5, 0]
    if plan.adapted_noise is not None:
        torch.testing.assert_close(plan.adapted_noise[:, 1], torch.full((4, 2), 0.3))
    for i in (0, 2):
        alone = lw.MPPI(**settings, value=lambda obs: obs[:, 0], seed=7 + i)
        torch.testing.assert_close(actions[i], alone(states[i], shift=0))


def test_invalid_states_and_masks_raise_an_error() -> None:
    with pytest.raises(ValueError, match="plants .* 0"):
        lw.MPPI("point_mass", plants=0)
    plan = lw.MPPI("point_mass", horizon=3, samples=4, plants=2)
    states = states_of("point_mass", 2)
    with pytest.raises(ValueError, match=r"the states .* of shape \(2, .* plan.state_of"):
        plan(states[0])
    states[1, 1] = torch.nan
    with pytest.raises(ValueError, match="the state of plant 1 has nan"):
        plan(states)
    with pytest.raises(ValueError, match="where .* float32"):
        plan.reset(where=torch.zeros(2))
    with pytest.raises(ValueError, match=r"2 plants, not \[1, 2, 3\]"):
        plan.reset([1, 2, 3])
    with pytest.raises(ValueError, match="seed .* to 2147483646, not 2147483647"):
        plan.reset(2**31 - 1)
    with pytest.raises(ValueError, match="seed .* -1"):
        plan.reset([1, -1])
    assert plan.seeds == [0, 1]
    with pytest.raises(ValueError, match="2 plants, .* plants=1"):
        lw.control(lw.make("point_mass", autoreset=False), plan, steps=2)


def test_too_many_plants_for_the_memory_raise_an_error() -> None:
    with pytest.raises(ValueError, match=r"use nworld=.*, where nworld is plants \* samples \* models, 10000 "):
        lw.MPPI("point_mass", horizon=4, samples=10**5, plants=10**4)
