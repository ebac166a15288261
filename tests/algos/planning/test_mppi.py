"""Compare MPPI with a plain implementation, and control tasks with MPPI.

The planner computes in float32, and the plain implementation in float64, so rounding errors accumulate.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from form_tasks import Gifted
from plain_mppi import Plain
from rail_task import Picky, rail
from varied_task import Params as VariedParams, Varied, World as VariedWorld

import lyceum_warp as lw
import lyceum_warp.tasks
from lyceum_warp import MPPI, Row

ENGINES = ["mujoco", "warp"]
UPDATES: dict[str, dict[str, Any]] = {
    "mppi with knots": dict(knots=3, spline="linear", include_plan=True),
    "cem": dict(update="cem", elites=4),
    "cem with knots": dict(update="cem", elites=4, knots=4),
    "predictive sampling": dict(update="predictive_sampling"),
}
BUFFERS = ("actions", "nominal", "standard_noise", "sampled", "returns", "weights")


@wp.func
def weighed(s0: VariedWorld, action: Row[float], s1: VariedWorld, p: VariedParams) -> float:
    return s1.qpos[0] - 0.05 * action[0] * action[0] + s1.body_pos[p.arm][2]


class Weighed(Varied):
    reward = weighed


def place(obs: torch.Tensor) -> torch.Tensor:
    return -2 * (obs[:, 0] - obs[:, 4]).abs() - 0.1 * obs[:, 2] * obs[:, 3]


def reached(seed: int) -> tuple[lw.Env, torch.Tensor]:
    plant = lw.make("reach", seed=seed)
    return plant, plant.get_state()[0]


def falling_hopper(plant: lw.Env) -> torch.Tensor:
    plant.reset()
    state, parts = plant.get_state(), plant.state_space.parts
    state[:, parts["qpos"].start + 2], state[:, parts["qvel"].start + 2] = 0.15, 3.0
    plant.set_state(state)
    return state[0]


def heavy_arm() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(Path(lyceum_warp.tasks.__path__[0], "reach.xml")))
    for geom in spec.body("forearm").geoms:
        geom.density = 5000
    return spec


HOPPER = dict(task="hopper", horizon=12, samples=24, temperature=0.5, noise=0.8, healthy_reward=1.0,
              forward_reward_weight=1.0, integrator="euler")  # fmt: skip
POINT = dict(task="point_mass", horizon=9, samples=40, temperature=0.3)
REACH = dict(task="reach", horizon=16, samples=30, temperature=0.2, noise=1.0)
WEIGHED = dict(task=Weighed, models=3, horizon=6, samples=8, temperature=0.5, noise=1.0, smoothing=(1, 0, 0))
CASES: dict[str, dict[str, Any]] = {
    "reach": REACH,
    "stop": HOPPER | dict(termination="stop"),
    "ignore": HOPPER | dict(termination="ignore"),
    "value": POINT | dict(noise=[0.3, 0.6], discount=0.9, value=place, iterations=2, fill="repeat"),
    "covariance": POINT
    | dict(include_plan=False, noise=[[0.3, 0.2], [0.2, 0.25]], smoothing=(0.5, 0.3, 0.2), fill=[0.5, -0.25]),
    "frame_skip": REACH | dict(frame_skip=3),
    "model": REACH | dict(model=heavy_arm),
    "predictive_sampling": REACH | dict(update="predictive_sampling"),
    "cem": POINT | dict(update="cem", noise=[0.3, 0.6], elites=5, min_noise=[0.02, 0.05], iterations=2),
    "cem_smoothed": REACH | dict(update="cem", elites=6, min_noise=0.3, smoothing=(0.5, 0.3, 0.2)),
    "zero": REACH | dict(knots=5, spline="zero"),
    "linear": POINT | dict(noise=0.4, knots=4, spline="linear", fill=[0.5, -0.25], iterations=2),
    "cubic": REACH | dict(knots=4, spline="cubic"),
    "cubic_cem": POINT | dict(update="cem", noise=0.4, knots=3, elites=4, min_noise=0.05, fill="repeat"),
    "models": WEIGHED,
    "models_worst": WEIGHED | dict(risk="worst"),
}
ON_WARP = ("reach", "stop", "value", "covariance", "model", "cem_smoothed", "linear", "cubic_cem", "models")


@pytest.mark.quick(*(f"{case}-mujoco" for case in CASES), "cubic_cem-warp")
@pytest.mark.parametrize("case, engine", [*((case, "mujoco") for case in CASES), *((case, "warp") for case in ON_WARP)])
def test_plans_equal_those_of_a_plain_implementation(case: str, engine: str) -> None:
    check_against(engine, **CASES[case])


def check_against(engine: str, task: Any, iterations: int = 1, models: int = 1, **settings: Any) -> None:
    if "model" in settings:
        settings["model"] = settings["model"]()
    plan = MPPI(task, engine=engine, seed=5, iterations=iterations, models=models, **settings)
    fields = {name: rows.numpy() for name, rows in plan.model_fields.items()}
    plain = Plain(task, engine=engine, count=len(plan.knot_actions), fields=fields, **settings)
    knots = {name: settings[name] for name in ("knots", "spline") if name in settings}
    twin = MPPI(task, seed=5, samples=plan.samples, horizon=plan.horizon, iterations=1, **knots)
    plant = lw.make(task, engine=engine, seed=3, autoreset=False)
    if task == "hopper":
        falling_hopper(plant)
    starts = set()
    for call in range(5):
        state = plant.get_state()[0]
        starts.add(tuple(state.tolist()))
        noises = []
        for _ in range(iterations):
            twin(twin.state_of())
            noises.append(twin.standard_noise.double().numpy())
        shift = (1, 1, 2, 0, plan.horizon)[call]
        action = plan(state, shift=shift)
        assert np.array_equal(plan.standard_noise.numpy(), noises[-1])
        plain(state, noises, shift)
        if task == "hopper" and call == 0:
            steps = {plain.ended[:, k].argmax() for k in plain.ended.any(axis=0).nonzero()[0]}
            assert len(steps) > 1 and not plain.ended.all(axis=0).any(), "the episodes should end at different steps"
        assert torch.equal(action, plan.actions[0]) and action.data_ptr() != plan.actions.data_ptr()
        np.testing.assert_allclose(plan.sampled, plain.sampled, atol=2e-6, err_msg=f"samples of call {call}")
        assert models == 1 or (plan.model_returns.std(1) > 1e-4).all(), "a sample earns the same in all models"
        np.testing.assert_allclose(plan.returns, plain.returns, atol=5e-5, rtol=5e-6, err_msg=f"returns of call {call}")
        np.testing.assert_allclose(plan.weights, plain.weights, atol=1e-4, err_msg=f"weights of call {call}")
        np.testing.assert_allclose(plan.actions, plain.actions, atol=2e-4, err_msg=f"plan of call {call}")
        if plan.adapted_noise is not None:
            np.testing.assert_allclose(plan.adapted_noise, plain.deviation, atol=2e-4, err_msg=f"noise of call {call}")
        summary = plan.summary
        assert summary["best_return"] == pytest.approx(plain.returns.max(), rel=1e-4)
        assert summary["mean_return"] == pytest.approx(plain.returns.mean(), rel=1e-4)
        assert summary["effective_samples"] == pytest.approx(1 / (plain.weights**2).sum(), rel=1e-2)
        assert summary["failed_samples"] == 0
        # with a low temperature, rounding errors would grow from plan to plan
        plain.knots = plan.knot_actions.double().numpy()
        if plan.adapted_noise is not None:
            plain.deviation = plan.adapted_noise.double().numpy()
        plant.step(action[None])
    assert len(starts) == 5


def test_terminal_value_of_a_terminated_sample_is_zero() -> None:
    state = falling_hopper(lw.make("hopper"))
    stop = MPPI(seed=1, **HOPPER)
    value = MPPI(seed=1, **HOPPER | dict(value=lambda obs: torch.full((len(obs),), 100.0)))
    stop(state), value(state)
    assert set((value.returns - stop.returns).round().tolist()) == {0.0, 100.0}


def numbers(plan: MPPI, state: torch.Tensor) -> list[torch.Tensor]:
    result = []
    for _ in range(4):
        result.append(plan(state))
        result += [getattr(plan, name).clone() for name in BUFFERS]
    return result


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("update", ["mppi", *UPDATES])
def test_equal_seeds_give_equal_plans_before_and_after_a_reset(update: str) -> None:
    words = UPDATES.get(update, {})
    plan, twin, other = (MPPI("reach", seed=seed, horizon=8, samples=10, **words) for seed in (4, 4, 5))
    _, state = reached(0)
    first = numbers(plan, state)
    assert same(first, numbers(twin, state))
    different = numbers(other, state)
    for a, b in zip(first, different, strict=True):
        assert not torch.equal(a, b) or not a.any() or update != "mppi"  # the first plan starts from zero actions
    assert not same(first, numbers(plan, state)), "without a reset, plans and noise go on"
    plan.reset()
    assert same(first, numbers(plan, state))
    plan.reset(5)
    assert plan.seeds == [5] and same(numbers(plan, state), different)


def test_random_models_depend_on_the_seed_and_differ_from_the_plant_model() -> None:
    plan, twin, other = (MPPI(Varied, horizon=2, samples=3, models=4, seed=seed) for seed in (1, 1, 2))
    masses = plan.model_fields["body_mass"].clone()
    assert torch.equal(masses, twin.model_fields["body_mass"])
    assert not torch.equal(masses, other.model_fields["body_mass"])
    other.reset(1)
    assert torch.equal(masses, other.model_fields["body_mass"])
    plant = lw.make(Varied, nworld=12, autoreset=False, seed=1)
    plant.rand_reset(1)
    drawn = plant.get_state()[:, plant.state_space.parts["body_mass"]]
    assert not torch.isin(masses[:, 1], drawn[:, 1]).any()


def test_sample_counts_as_failed_if_it_fails_in_one_model() -> None:
    plan = MPPI(Varied, horizon=3, samples=4, models=2)
    plan.model_fields["body_mass"][1, 1] = torch.nan
    plan(plan.state_of())
    assert torch.isinf(plan.model_returns[:, 1]).all() and torch.isinf(plan.returns).all()
    assert torch.isfinite(plan.model_returns[:, 0]).all()


@pytest.mark.quick("reward-mujoco", "large reward-mujoco", "physics-warp", "value-mujoco")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("how", ["reward", "large reward", "physics", "value"])
def test_failed_samples_have_no_weight(how: str, engine: str) -> None:
    settings: dict[str, Any] = dict(horizon=4, samples=40, smoothing=(1, 0, 0), temperature=1.0, engine=engine)
    if how == "physics":
        # with these motors, large actions cause accelerations (MuJoCo) or velocities (Warp) above 1e10
        settings |= dict(noise=1.0, limit=1e9, model=rail({"mujoco": 1e10, "warp": 2.5e12}[engine]))
    elif how == "value":
        settings |= dict(noise=1.0, limit=1e9, value=lambda obs: torch.where(obs[:, 0] > 0, torch.nan, 1.0))
    else:
        settings |= dict(noise=0.3, wrong=2e10 if how == "large reward" else np.inf)
    plan = MPPI(Picky, **settings)
    for _ in range(4):
        state = plan.state_of()
        plan(state)
        bad = torch.isinf(plan.returns)
        assert 0 < bad.sum() < 40, "all or none failed: nothing was tested"
        if "reward" in how:
            assert torch.equal(bad, (plan.sampled > 0.5).any(0).any(-1))
        good = plan.sampled[:, ~bad].double()
        weights = torch.softmax(plan.returns[~bad].double(), 0)
        assert not plan.weights[bad].any()
        torch.testing.assert_close(plan.weights[~bad].double(), weights, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(plan.actions.double(), torch.einsum("k,tki->ti", weights, good), atol=1e-4, rtol=0)
        summary = plan.summary
        assert summary["failed_samples"] == bad.sum()
        assert summary["mean_return"] == pytest.approx(plan.returns[~bad].mean().item(), rel=1e-4, abs=1e-5)
        assert summary["effective_samples"] == pytest.approx(1 / (weights**2).sum().item(), rel=1e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_plan_keeps_its_shifted_actions_if_all_samples_fail(engine: str, caplog: pytest.LogCaptureFixture) -> None:
    plan = MPPI(Picky, engine=engine, horizon=5, samples=8, noise=0.1, limit=10.0, seed=3, update="cem")
    plan(plan.state_of())
    for _ in range(3):
        old, spread = plan.actions.clone(), plan.adapted_noise.clone()
        plan.env.set_params(limit=-10.0)
        action = plan(plan.state_of())
        assert torch.equal(plan.actions, torch.cat([old[1:], torch.zeros(1, 1)]))
        assert torch.equal(action, old[1]) and not plan.weights.any()
        assert plan.summary["failed_samples"] == 8 and plan.summary["best_return"] == -np.inf
        assert torch.equal(plan.adapted_noise, torch.cat([spread[1:], torch.full((1, 1), 0.1)]))
        plan.env.set_params(limit=10.0)
        plan(plan.state_of())
        assert plan.summary["failed_samples"] == 0 and torch.isfinite(plan.actions).all()
    (message,) = caplog.messages
    assert "all 8 samples of a plan of picky failed (returns are not finite)" in message


def test_planner_with_unstable_physics_suggests_shorter_substeps(caplog: pytest.LogCaptureFixture) -> None:
    plan = MPPI(Picky, horizon=4, samples=8, noise=1e3, include_plan=False, limit=1e9, model=rail(1e10))
    plan(plan.state_of())
    assert plan.sampled.abs().max() > 100.0, "the actions of this task have no bounds"
    (message,) = caplog.messages
    assert "faults: NAN" in message
    step = plan.env.model.opt.timestep
    assert f"timestep={step / 2:g}, frame_skip={2 * plan.env.task.frame_skip}" in message


@pytest.mark.parametrize("update, elites", [("cem", 3), ("cem", 7), ("predictive_sampling", None)])
def test_failed_samples_are_not_among_the_best(update: str, elites: int | None) -> None:
    plan = MPPI(Picky, horizon=4, samples=8, noise=0.3, limit=0.2, update=update, elites=elites, seed=1)
    plan(plan.state_of())
    good = torch.isfinite(plan.returns)
    assert 0 < good.sum() < 7 and plan.summary["failed_samples"] == 8 - good.sum()
    count = min(elites or 1, int(good.sum()))
    best = plan.returns.argsort(descending=True, stable=True)[:count]
    assert plan.weights.nonzero().ravel().tolist() == sorted(best.tolist())
    torch.testing.assert_close(plan.weights[best], torch.full((count,), 1 / count))
    torch.testing.assert_close(plan.actions, plan.sampled[:, best].mean(1))
    assert plan.summary["effective_samples"] == pytest.approx(count)


@pytest.mark.parametrize("knots", [None, 3])
def test_shift_by_the_largest_number_of_steps_gives_a_constant_plan(knots: int | None) -> None:
    plan = MPPI("point_mass", horizon=6, samples=5, knots=knots, fill="repeat")
    plan(plan.state_of())
    assert plan.actions.any()
    plan(plan.state_of(), shift=2**31 - 1)
    assert (plan.nominal == plan.nominal[0]).all()


@wp.func
def place_in_warp(obs: Row[float]) -> float:
    return -2.0 * wp.abs(obs[0] - obs[4]) - 0.1 * obs[2] * obs[3]


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_equal_value_functions_in_torch_and_warp_give_equal_plans(engine: str) -> None:
    settings = POINT | dict(engine=engine, noise=0.5, discount=0.9, iterations=2)
    in_torch, column, in_warp, without = (
        MPPI(value=value, **settings) for value in (place, lambda obs: place(obs)[:, None], place_in_warp, None)
    )
    plant = lw.make("point_mass", seed=2, engine=engine)
    for _ in range(4):
        state = plant.get_state()[0]
        plant.step(in_torch(state)[None])
        column(state), in_warp(state), without(state)
        assert torch.equal(column.actions, in_torch.actions)
        for name in BUFFERS:
            torch.testing.assert_close(getattr(in_warp, name), getattr(in_torch, name), rtol=1e-5, atol=1e-5)
        assert not torch.allclose(without.returns, in_torch.returns, atol=0.01)


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_value_function_receives_the_step_at_the_end_of_the_plan(engine: str) -> None:
    value = lw.ValueFunction(6, (16,), scale=50.0, time_orders=2, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.nn.init.xavier_uniform_(value.network[-1].weight)  # the initial weights are zero
        value.network[0].weight[:, 6:] *= 300  # make the value change within ten steps
    settings = POINT | dict(engine=engine, noise=0.5)
    plan = MPPI(value=value, **settings)

    def at_step(step: int) -> MPPI:
        return MPPI(value=lambda obs: value(obs, torch.full((len(obs),), float(step))), **settings)

    for step in (0, 100):
        right, wrong = at_step(step + plan.horizon), at_step(step)
        plan.reset()
        for _ in range(3):
            state = plan.state_of(step=step, qpos=[0.1, 0.2, -0.5, 0.3])
            plan(state), right(state), wrong(state)
            torch.testing.assert_close(plan.returns, right.returns, rtol=1e-6, atol=1e-6)
            torch.testing.assert_close(plan.actions, right.actions, rtol=1e-5, atol=1e-5)
            assert not torch.allclose(plan.returns, wrong.returns, atol=1e-3)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda obs: obs, r"value .* 7 numbers for \(7, 6\) observations, not .* \(7, 6\)"),
        (lambda obs: 0.0, "value .* 7 numbers .* 0.0"),
        (torch.nn.Linear(5, 1), r"value .* \(7, 6\)"),
        (lw.ValueFunction(3), "3 observations, .* 'policy'"),
        (lw.TwinCritic(6, 2), "value .* 'action'"),
        (3.0, "value .* 3.0"),
    ],
)  # fmt: skip
def test_invalid_value_function_raises_an_error_when_the_planner_is_made(value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MPPI("point_mass", horizon=3, samples=7, value=value)


def test_random_events_differ_between_samples_and_iterations() -> None:
    drawn: list[torch.Tensor] = []

    def value(obs: torch.Tensor) -> torch.Tensor:
        drawn.append(obs[:, 1].double())  # a sum of random numbers, one for each step
        return obs[:, 0]

    plan = MPPI(Gifted, horizon=3, samples=200, iterations=2, seed=4, value=value)
    state = plan.state_of()
    plan(state), plan(state)
    found = torch.stack(drawn[-4:])
    assert found.std(1).min() > 0.5
    assert np.abs(np.corrcoef(found.numpy()) - np.eye(4)).max() < 4 / 200**0.5
    plan.reset(4)
    plan(state), plan(state)
    assert torch.equal(torch.stack(drawn[-4:]), found), "draws are counted from the planner's seed"


def test_seed_or_shift_that_is_not_a_whole_number_raises_an_error() -> None:
    plan = MPPI("point_mass", horizon=3, samples=2)
    for wrong in (-1, 0.5, "a"):
        with pytest.raises(ValueError, match=f"seed .* {wrong!r}"):
            plan.reset(wrong)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=f"shift .* {wrong!r}"):
            plan(plan.state_of(), shift=wrong)  # type: ignore[arg-type]
