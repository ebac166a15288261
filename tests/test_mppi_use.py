"""MPPI in use: values, recordings, other models, attained returns, and what is refused."""

import re
import types
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from test_mppi import POINT, Picky, heavy_arm, numbers, place, reached, same

import lyceum_warp as lw
from lyceum_warp import MPPI, Row
from lyceum_warp.algos import mppi
from lyceum_warp.engines import placement

ENGINES = ["mujoco", "warp"]
BUFFERS = ("actions", "nominal", "standard_noise", "sampled", "returns", "weights")


# the terminal value


@wp.func
def place_in_warp(obs: Row[float]) -> float:
    return -2.0 * wp.abs(obs[0] - obs[4]) - 0.1 * obs[2] * obs[3]


@pytest.mark.parametrize("engine", ENGINES)
def test_values_in_torch_and_in_warp(engine: str) -> None:
    """Where both compute the same the plans are the same, and not those without a value."""
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


@pytest.mark.parametrize("engine", ENGINES)
def test_a_value_function_is_told_the_step_at_the_end(engine: str) -> None:
    """One with time features values where samples end at the step that it then is."""
    value = lw.ValueFunction(6, (16,), scale=50.0, time_orders=2, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        value.network[0].weight[:, 6:] *= 300  # so that ten steps make a difference
    settings = POINT | dict(engine=engine, noise=0.5)
    plan = MPPI(value=value, **settings)

    def told(step: int) -> MPPI:
        return MPPI(value=lambda obs: value(obs, torch.full((len(obs),), float(step))), **settings)

    for step in (0, 100):
        right, wrong = told(step + plan.horizon), told(step)
        plan.reset()
        for _ in range(3):
            state = plan.state_of(step=step, qpos=[0.1, 0.2, -0.5, 0.3])
            plan(state), right(state), wrong(state)
            torch.testing.assert_close(plan.returns, right.returns, rtol=1e-6, atol=1e-6)
            torch.testing.assert_close(plan.actions, right.actions, rtol=1e-5, atol=1e-5)
            assert not torch.allclose(plan.returns, wrong.returns, atol=1e-3)


def test_values_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match=r"value has to make 7 numbers of \(7, 6\) observations, not .* \(7, 6\)"):
        MPPI("point_mass", horizon=3, samples=7, value=lambda obs: obs)
    with pytest.raises(ValueError, match="value has to make 7 numbers of .*, not float 0.0"):
        MPPI("point_mass", horizon=3, samples=7, value=lambda obs: 0.0)  # type: ignore[arg-type,return-value]


# recordings, states, other models


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("value", [None, place, place_in_warp], ids=["none", "torch", "warp"])
def test_recorded_or_not_makes_no_difference(value: Any, engine: str) -> None:
    settings = POINT | dict(engine=engine, noise=0.5, iterations=2, value=value)
    recorded, unrecorded = (MPPI(record=record, **settings) for record in (True, False))
    state = recorded.state_of(qpos=[0.1, 0.2, -0.5, 0.3])
    assert same(numbers(recorded, state, 5), numbers(unrecorded, state, 5))


def test_a_state_by_its_parts() -> None:
    """What a robot knows is set, the rest is that of a fixed reset."""
    plan = MPPI("reach", horizon=4, samples=4)
    plant = lw.make("reach", autoreset=False)
    plant.reset()
    parts = plant.state_space.parts
    assert torch.equal(plan.state_of(), plant.get_state()[0])
    qpos = np.linspace(-0.5, -0.1, 7)
    state = plan.state_of(qpos=qpos, qvel=[0.1] * 7, time=0.3, mocap_pos=torch.tensor([[0.1, 0.2, 0.3]]), step=15)
    expected = plant.get_state()[0]
    expected[parts["qpos"]], expected[parts["qvel"]] = torch.from_numpy(qpos), 0.1
    expected[parts["time"]], expected[parts["step"]] = 0.3, 15
    expected[parts["mocap_pos"]] = torch.tensor([0.1, 0.2, 0.3]).double()
    assert torch.equal(state, expected)
    assert torch.equal(plan.state_of(), plant.get_state()[0]), "one state has changed the next"
    plan(state)
    with pytest.raises(ValueError, match="a state of 'reach' has no part 'qpoz': it has .*'qpos'"):
        plan.state_of(qpoz=qpos)
    with pytest.raises(ValueError, match="the part 'qpos' of a state has 7 numbers, not 6"):
        plan.state_of(qpos=qpos[1:])


def test_a_state_that_does_not_fit_is_refused() -> None:
    plan = MPPI("point_mass", horizon=3, samples=4)
    state = plan.state_of()
    size = len(state)
    before = plan.actions.clone()
    for wrong, told in (
        (state.float(), f"a float64 tensor of shape ({size},), not a float32 tensor of shape ({size},)"),
        (state[1:], f"not a float64 tensor of shape ({size - 1},)"),
        (state.expand(2, -1), f"not a float64 tensor of shape (2, {size})"),
        (state.numpy(), f"not a ndarray of shape ({size},)"),
        (None, "not NoneType None"),
    ):
        with pytest.raises(ValueError, match=re.escape(told)):
            plan(wrong)  # type: ignore[arg-type]
    for part, number in (("qvel", np.nan), ("qpos", np.inf), ("time", -np.inf)):
        broken = state.clone()
        broken[plan.env.state_space.parts[part]] = number
        with pytest.raises(ValueError, match=f"the state to plan from has {number} in its '{part}'"):
            plan(broken)
    assert torch.equal(plan.actions, before), "a refused state has changed the plan"
    one_row = MPPI("point_mass", horizon=3, samples=4)
    assert torch.equal(one_row(state[None]), plan(state))


@pytest.mark.parametrize("plant_engine, engine", [("warp", "mujoco"), ("mujoco", "warp")])
def test_the_plant_may_run_on_the_other_engine(plant_engine: str, engine: str) -> None:
    """Its states mean the same on both, so that plans differ by the engines' arithmetic only."""
    plant = lw.make("reach", engine=plant_engine, nworld=3, seed=1)
    there, here = (MPPI("reach", engine=e, temperature=1.0) for e in (plant_engine, engine))
    for _ in range(4):
        state = plant.get_state()[2]
        there.actions.copy_(here.actions)
        action = here(state)
        torch.testing.assert_close(there(state), action, atol=1e-3, rtol=0)
        torch.testing.assert_close(there.returns, here.returns, atol=1e-3, rtol=1e-4)
        plant.step(action.expand(3, -1).contiguous())


def test_a_model_of_the_planners_own() -> None:
    """A heavier arm plans other actions, and one with a longer step looks further ahead; the state stays the same."""
    _, state = reached(2)
    plain, heavy, long = MPPI("reach"), MPPI("reach", model=heavy_arm()), MPPI("reach", frame_skip=6)
    for plan in (plain, heavy, long):
        plan(state)
    assert torch.equal(plain.sampled, heavy.sampled) and torch.equal(plain.sampled, long.sampled)
    assert heavy.env.model.body_mass.sum() > plain.env.model.body_mass.sum() + 5
    assert (plain.timestep, long.timestep) == (0.02, pytest.approx(0.06))
    assert not torch.allclose(plain.returns, heavy.returns, atol=0.01)
    assert not torch.allclose(plain.returns, long.returns, atol=0.01)


# it controls


def drive(task: str, steps: int, seed: int, **settings: Any) -> tuple[lw.Env, np.ndarray, np.ndarray]:
    """Drive a plant; return it, with its rewards and evaluations up to its end or success."""
    plan = MPPI(task, seed=seed, **settings)
    plant = lw.make(task, autoreset=False, seed=seed)
    rewards, evals = [], []
    for _ in range(steps):
        plant.step(plan(plant.get_state()[0])[None])
        rewards.append(plant.reward.item())
        evals.append(plant.eval.item())
        if plant.success.any() or plant.terminated.any():
            break
    return plant, np.array(rewards), np.array(evals)


@pytest.mark.parametrize("seed", range(3))
def test_reach_gets_to_its_target(seed: int) -> None:
    plant, rewards, evals = drive("reach", 75, seed)
    assert plant.success.item(), f"{evals[-1]:.3f} m after {len(evals)} steps"
    assert evals[-10:].mean() < 0.05 and rewards.sum() > -250


def test_cartpole_swings_up_and_stays_up() -> None:
    _, _, evals = drive("cartpole_swingup", 200, 0)
    assert evals[0] < 0
    assert evals[-20:].min() > 0.9, evals[-20:]


def test_half_cheetah_runs() -> None:
    _, _, evals = drive("half_cheetah", 50, 1)
    assert evals[-1] - evals[0] > 2.5


@pytest.mark.slow
def test_hopper_hops_without_a_fall() -> None:
    """With the settings that it comes with; those of other tasks let it fall after some 100 steps."""
    plant, rewards, evals = drive("hopper", 130, 1)
    assert len(evals) == 130 and not plant.terminated.item()
    assert evals[-1] > 0.3 and rewards.sum() > 165, (evals[-1], rewards.sum())


# what makes no sense is refused


@wp.func
def value_of_two(obs: Row[float], step: float) -> float:
    return obs[0] + step


@pytest.mark.parametrize(
    "name, wrong",
    [
        ("horizon", [0, -1, 2.5, "a", np.nan]),
        ("samples", [0, -1, 2.5, "a", np.inf]),
        ("iterations", [0, -1, 2.5, "a"]),
        ("temperature", [0, -1, np.nan, "a", 1e-60]),
        ("discount", [2, -0.1, np.nan, "a"]),
        ("noise", [-1, np.nan, np.inf, [1, 2, 3], [1, -1], [[1, 2], [2, 1]], [[1, 0.5], [0.2, 1]], np.eye(3), "a",
                   [1, [2, 3]]]),
        ("smoothing", [(1, 0), 1, (1, 0, np.nan), "abc", [1, [2, 3], 4]]),
        ("fill", ["x", [1], [1, np.nan], 0.5, [1, 2, 3], ["a", "b"]]),
        ("termination", ["x", True, 3]),
        ("value", [value_of_two, 3.0, "a"]),
        ("seed", [-1, 0.5, "a"]),
        ("temprature", [1.0]),
        ("nthread", [-1, "a"]),
    ],
)  # fmt: skip
def test_bad_arguments_are_named(name: str, wrong: list[Any]) -> None:
    for value in wrong:
        with pytest.raises(ValueError, match=name):
            MPPI("point_mass", **{"horizon": 3, "samples": 4} | {name: value})
            pytest.fail(f"{name}={value!r} was taken")


def test_planning_of_a_task() -> None:
    """What the task says holds where nothing else is said; what it says wrongly is refused, too."""
    plan = MPPI("reach")
    assert (plan.horizon, plan.samples, plan.temperature) == (16, 30, 0.2)
    assert MPPI("reach", horizon=5).horizon == 5 and MPPI("reach", horizon=5).samples == 30
    plan = MPPI("point_mass")
    assert (plan.horizon, plan.samples, plan.temperature, plan.discount, plan.iterations) == (32, 64, 0.1, 1.0, 1)
    wrong = type("Wrong", (Picky,), {"planning": {"horizont": 3}})
    with pytest.raises(ValueError, match="no parameter 'horizont': did you mean horizon"):
        MPPI(wrong)
    # the planner's worlds alone are told of the rest, and what is given counts more
    plan = MPPI("hopper", horizon=2, samples=2)
    assert (plan.env.task.params["healthy_reward"], plan.settings["healthy_reward"]) == (2.0, 2.0)
    assert plan.env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    plan = MPPI("hopper", horizon=2, samples=2, healthy_reward=1.0, integrator="rk4")
    assert plan.env.task.params["healthy_reward"] == 1.0
    assert plan.env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4


@pytest.mark.parametrize("name", ["horizon", "samples", "temperature", "noise", "smoothing", "discount", "iterations",
                                  "fill", "termination", "value", "seed"])  # fmt: skip
def test_settings_stay_as_they_are(name: str) -> None:
    plan = lw.MPPI("point_mass", horizon=3, samples=2)
    with pytest.raises(AttributeError, match=rf"{name}=2\.0"):
        setattr(plan, name, 2.0)


@pytest.mark.parametrize("name", ["nworld", "autoreset"])
def test_options_that_are_the_planners_own(name: str) -> None:
    with pytest.raises(ValueError, match=f"a planner takes no {name}"):
        lw.MPPI("point_mass", **{name: 1})


def test_a_value_of_other_observations_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"value can't take observations .* \(2, 6\)"):
        lw.MPPI("point_mass", samples=2, value=torch.nn.Linear(5, 1))


def test_a_value_function_brings_its_discount() -> None:
    value = lw.ValueFunction(6)
    value.discount = 0.9
    assert lw.MPPI("point_mass", samples=2, value=value).discount == 0.9
    assert lw.MPPI("point_mass", samples=2, value=value, discount=0.5).discount == 0.5


def test_a_time_tells_the_step() -> None:
    plan = lw.MPPI("reach", horizon=2, samples=2)
    step = plan.env.state_space.parts["step"]
    assert plan.state_of(time=0.2)[step] == 10
    assert plan.state_of(time=0.2, step=3)[step] == 3
    with pytest.raises(ValueError, match="has to be numbers"):
        plan.state_of(qpos="zero")


def test_a_planner_is_not_disturbed_by_resets_of_its_worlds() -> None:
    env = lw.make("reach", autoreset=False)
    env.rand_reset(0)
    plans = [lw.MPPI("reach", horizon=3, samples=4) for _ in range(2)]
    plans[0].env.reset(torch.tensor([True, False, False, False]))
    for _ in range(3):
        state = env.get_state()
        first, second = (plan(state) for plan in plans)
        assert torch.equal(first, second)
        env.step(first[None])
    assert plans[0].env.episode_step.tolist() == [2, 2, 2, 2]


def test_auto_chooses_by_the_number_of_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU; what was chosen by hand stays."""
    monkeypatch.setattr(
        placement, "find_device", lambda name: types.SimpleNamespace(is_cuda=str(name).startswith("cuda"))
    )

    def chosen(task: str, samples: int, **options: Any) -> tuple[str | None, str | None]:
        placed = mppi._placed(task, {"device": "cuda:0", "nthread": 2} | options, samples)
        return placed.get("engine"), placed.get("device")

    cpu, gpu = ("mujoco", "cpu"), ("warp", "cuda:0")
    assert [chosen("reach", n) for n in (79, 80)] == [cpu, gpu]
    assert chosen("reach", 79, nthread=1) == gpu and chosen("reach", 1, engine="warp") == gpu
    assert chosen("reach", 640, nthread=128) == gpu, "more than 16 cores were not measured"
    assert chosen("reach", 4096, device="cpu") == (None, "cpu")
    # the hand's noslip solver is slow on a GPU, unless it is turned off
    assert [chosen("adroit_pen", n) for n in (160, 479, 480)] == [cpu, cpu, gpu]
    assert chosen("adroit_pen", 160, solver={"noslip_iterations": 0}) == gpu
    assert chosen("adroit_pen", 160, solver=4) == cpu  # what is wrong with it, the environment tells


def test_a_value_is_of_what_the_task_itself_pays() -> None:
    """Hopper's planning pays the planner's worlds for standing; a value function knows nothing of that."""
    plan = MPPI("hopper", horizon=2, samples=2, value=lambda obs: obs[:, 0])
    assert plan.env.task.params["healthy_reward"] == 1.0 and plan.env.task.params["forward_reward_weight"] == 1.0
    assert plan.env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and plan.settings["noise"] == 0.1
