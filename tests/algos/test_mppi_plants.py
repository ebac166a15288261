"""Planning for several plants at a time: the plans are those of planners with one plant each."""

from typing import Any

import pytest
import torch
import warp as wp
from varied_task import Varied

import lyceum_warp as lw
from lyceum_warp import Row

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
    "stop": dict(task="hopper", termination="stop"),
    "frame skip": dict(task="reach", frame_skip=2),
}
BUFFERS = ("actions", "nominal", "knot_actions", "standard_noise", "sampled", "adapted_noise")  # the second axis
FIRST = ("returns", "weights", "model_returns")


@wp.func
def first_squared(obs: Row[float]) -> float:
    return 3.0 * obs[0] * obs[0]


def states_of(task: Any, count: int) -> torch.Tensor:
    return lw.make(task, nworld=count, autoreset=False, seed=3).get_state()


@pytest.mark.parametrize(
    "case, engine", [*((c, "mujoco") for c in CASES), *((c, "warp") for c in ("mppi", "cem with knots", "models"))]
)
def test_plans_for_several_plants_are_those_of_single_planners(case: str, engine: str) -> None:
    settings = dict(horizon=6, samples=8, temperature=0.5, engine=engine) | CASES[case]
    states = states_of(settings["task"], 3)
    together = lw.MPPI(**settings, seed=5, plants=3)
    alone = [lw.MPPI(**settings, seed=5 + i) for i in range(3)]
    for plan in alone:  # planners with several plants have one set of models
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


@pytest.mark.parametrize("kind", ["torch", "warp", "fitted"])
def test_values_are_those_of_every_plants_samples(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    fitted = lw.ValueFunction(6, time_orders=2)
    for weights in fitted.parameters():
        torch.nn.init.normal_(weights, generator=generator)
    value = {"torch": lambda obs: 3.0 * obs[:, 0] ** 2, "warp": first_squared, "fitted": fitted}[kind]
    settings = dict(horizon=4, samples=5, value=value)
    states = states_of("point_mass", 2)
    states[1, lw.make("point_mass").state_space.parts["step"]] = 60
    together = lw.MPPI("point_mass", plants=2, seed=7, **settings)
    actions = together(states)
    for i in range(2):
        alone = lw.MPPI("point_mass", seed=7 + i, **settings)
        torch.testing.assert_close(actions[i], alone(states[i]))
        torch.testing.assert_close(together.returns[i], alone.returns)


def test_some_plants_restart() -> None:
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
    again = plan(states)
    torch.testing.assert_close(again[2], lw.MPPI("point_mass", horizon=5, samples=6, update="cem", elites=2, knots=2,
                                                 seed=1)(states[2]))  # fmt: skip
    plan.reset(9, where=torch.tensor([True, False, False]))
    assert plan.seed == 4  # the others keep theirs
    torch.testing.assert_close(plan(states)[0], lw.MPPI("point_mass", horizon=5, samples=6, update="cem", elites=2,
                                                        knots=2, seed=9)(states[0]))  # fmt: skip
    assert not torch.allclose(again[0], again[1])


def test_a_plan_for_each_world_controls_an_environment() -> None:
    env = lw.make("point_mass", nworld=4, seed=2, horizon=30)
    plan = lw.MPPI("point_mass", horizon=12, samples=64, temperature=0.1, plants=4)
    start, ended = env.reward.clone(), 0
    distance = env.obs[:, :2].clone() - env.obs[:, 4:6]
    for _ in range(29):
        env.step(plan(env.get_state()))
        plan.reset(where=env.done)
        ended += int(env.done.sum())
    now = env.obs[:, :2] - env.obs[:, 4:6]
    assert ended == 0 and start.shape == (4,)
    assert (now.norm(dim=1) < 0.3 * distance.norm(dim=1)).all()


@pytest.mark.parametrize("plants", [0, 2.5, True, "3"])
def test_plants_are_a_whole_number(plants: Any) -> None:
    with pytest.raises(ValueError, match=f"plants must be a whole number .*, not {plants!r}"):
        lw.MPPI("point_mass", plants=plants)


def test_bad_input_gets_one_line() -> None:
    plan = lw.MPPI("point_mass", horizon=3, samples=4, plants=2)
    states = states_of("point_mass", 2)
    with pytest.raises(ValueError, match=r"the states to plan from must be a float64 tensor of shape \(2, "):
        plan(states[0])
    states[1, 1] = torch.nan
    with pytest.raises(ValueError, match="the state of plant 1 to plan from has nan in its "):
        plan(states)
    with pytest.raises(ValueError, match=r"where must be a bool tensor of shape \(2,\), not a float32 tensor"):
        plan.reset(where=torch.zeros(2))
    with pytest.raises(ValueError, match=r"one for each of 2 plants, not \[1, 2, 3\]"):
        plan.reset([1, 2, 3])
    with pytest.raises(ValueError, match=r"seed must be a whole number .* not -1"):
        plan.reset([1, -1])
    with pytest.raises(AttributeError, match="make another MPPI with plants=3"):
        plan.plants = 3
    with pytest.raises(ValueError, match="plans for 2 plants, and one is controlled here: make it with plants=1"):
        lw.control(lw.make("point_mass", autoreset=False), plan, steps=2)
