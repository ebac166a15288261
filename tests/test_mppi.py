"""MPPI: the planner against a plain version of it, its weights against their formula, and what it controls.

The planner's own arithmetic is float32; the plain version's is float64, and so the two drift apart by roundings.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp import MPPI, Row
from lyceum_warp.tasks.reach import arm

ENGINES = ["mujoco", "warp"]
BUFFERS = ("actions", "nominal", "standard_noise", "sampled", "returns", "weights")


# a plain MPPI, one thing after the other


def smoothed(noise: np.ndarray, betas: tuple[float, ...]) -> np.ndarray:
    """Noise over time, (horizon, ...): the first two steps stay as they are, those after mix with the last two."""
    result = noise.copy()
    for t in range(2, len(noise)):
        result[t] = betas[0] * noise[t] + betas[1] * result[t - 1] + betas[2] * result[t - 2]
    return result


class Plain:
    """MPPI by its definition. Standard normal numbers are given to it; everything else it does itself."""

    def __init__(
        self,
        task: str,
        *,
        engine: str,
        horizon: int,
        samples: int,
        temperature: float,
        noise: Any,
        smoothing: tuple[float, ...] = (0.25, 0.8, 0.0),
        discount: float = 1.0,
        fill: Any = "zero",
        termination: str = "stop",
        value: Callable[[torch.Tensor], torch.Tensor] | None = None,
        **options: Any,
    ) -> None:
        self.env = lw.make(task, engine=engine, nworld=samples, autoreset=False, horizon=0, **options)
        self.low, self.high = self.env.action_space.low, self.env.action_space.high
        nu = len(self.low)
        array = np.asarray(noise, dtype=float)
        self.factor = np.linalg.cholesky(array) if array.ndim == 2 else np.diag(np.broadcast_to(array, nu))
        self.temperature, self.smoothing, self.discount = temperature, smoothing, discount
        self.stop, self.value, self.repeat = termination == "stop", value, isinstance(fill, str) and fill == "repeat"
        self.fill = np.zeros(nu) if isinstance(fill, str) else np.asarray(fill, dtype=float)
        self.actions = np.tile(np.clip(self.fill, self.low, self.high), (horizon, 1))

    def __call__(self, state: torch.Tensor, noises: list[np.ndarray], shift: int = 1) -> None:
        for _ in range(shift):
            last = self.actions[-1] if self.repeat else np.clip(self.fill, self.low, self.high)
            self.actions = np.vstack([self.actions[1:], last])
        for z in noises:
            self.improve(state, z)

    def improve(self, state: torch.Tensor, z: np.ndarray) -> None:
        noise = smoothed(np.einsum("ij,tkj->tki", self.factor, z), self.smoothing)
        self.sampled = np.clip(self.actions[:, None] + noise, self.low, self.high)
        rewards, ended, values = self.roll_out(state)
        self.returns = np.zeros(z.shape[1])
        for k in range(len(self.returns)):
            weight, going = 1.0, True
            for reward, end in zip(rewards[:, k], ended[:, k], strict=True):
                if going:
                    self.returns[k] += weight * reward
                    weight *= self.discount
                    going = not (self.stop and end)
            if going:
                self.returns[k] += weight * values[k]
        weights = np.exp((self.returns - self.returns.max()) / self.temperature)
        self.weights = weights / weights.sum()
        self.actions = np.einsum("k,tki->ti", self.weights, self.sampled)

    def roll_out(self, state: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards and ends of each step, and the values of where samples are after the last one."""
        env = self.env
        env.set_state(state.expand(env.nworld, -1).contiguous())
        rewards, ended = np.zeros((2, *self.sampled.shape[:2]))
        for t, actions in enumerate(self.sampled):
            env.step(torch.as_tensor(actions, dtype=torch.float32))
            rewards[t], ended[t] = env.reward.numpy(), env.terminated.numpy()
        self.ended = ended
        return rewards, ended, np.zeros(env.nworld) if self.value is None else self.value(env.obs).numpy()


class PlainReach(Plain):
    """Nothing but MuJoCo and NumPy: the reach task's physics and reward, too."""

    def roll_out(self, state: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = self.env.model
        data = mujoco.MjData(model)
        spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
        rewards = np.zeros(self.sampled.shape[:2])
        for k in range(rewards.shape[1]):
            mujoco.mj_setState(model, data, state[: mujoco.mj_stateSize(model, spec)].numpy(), spec)
            for t in range(len(rewards)):
                data.ctrl[:] = self.sampled[t, k]
                for _ in range(2):
                    mujoco.mj_step(model, data)
                mujoco.mj_kinematics(model, data)
                error = data.site("finger").xpos - data.mocap_pos[0]
                rewards[t, k] = -np.abs(error).sum() - 5 * np.sqrt((error**2).sum())
        return rewards, np.zeros_like(rewards), np.zeros(rewards.shape[1])


def place(obs: torch.Tensor) -> torch.Tensor:
    """A value of point_mass: far from the target and fast is bad."""
    return -2 * (obs[:, 0] - obs[:, 4]).abs() - 0.1 * obs[:, 2] * obs[:, 3]


def reached(seed: int) -> tuple[lw.Env, torch.Tensor]:
    plant = lw.make("reach", seed=seed)
    return plant, plant.get_state()[0]


def falling_hopper(plant: lw.Env) -> torch.Tensor:
    """A hopper that leans and turns: it falls within a few steps, when exactly depends on what it does."""
    plant.reset()
    state, parts = plant.get_state(), plant.state_space.parts
    state[:, parts["qpos"].start + 2], state[:, parts["qvel"].start + 2] = 0.15, 3.0
    plant.set_state(state)
    return state[0]


def heavy_arm() -> mujoco.MjSpec:
    spec = arm()
    for geom in spec.body("forearm").geoms:
        geom.density = 5000
    return spec


# the task's own planning has other weights for the planner's worlds alone
HOPPER = dict(task="hopper", horizon=12, samples=24, temperature=0.5, noise=0.8, healthy_reward=1.0,
              forward_reward_weight=1.0, integrator="euler")  # fmt: skip
POINT = dict(task="point_mass", horizon=9, samples=40, temperature=0.3)
REACH = dict(task="reach", horizon=16, samples=30, temperature=0.2, noise=1.0)
CASES: dict[str, dict[str, Any]] = {
    "reach": REACH,
    "stop": HOPPER | dict(termination="stop"),
    "ignore": HOPPER | dict(termination="ignore"),
    "value": POINT | dict(noise=[0.3, 0.6], discount=0.9, value=place, iterations=2, fill="repeat"),
    "covariance": POINT | dict(noise=[[0.3, 0.2], [0.2, 0.25]], smoothing=(0.5, 0.3, 0.2), fill=[0.5, -0.25]),
    "negative": POINT | dict(noise=[[0.3, -0.2], [-0.2, 0.25]], discount=0.5, iterations=3),
    "frame_skip": REACH | dict(frame_skip=3),
    "model": REACH | dict(model=heavy_arm),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("case", CASES)
def test_a_plan_is_that_of_the_definition(case: str, engine: str) -> None:
    """Call after call, with the plant moving along: actions, returns and weights are those of the plain version."""
    check_against(Plain, engine, **CASES[case])


def test_a_plan_for_reach_is_that_of_nothing_but_mujoco_and_numpy() -> None:
    check_against(PlainReach, "mujoco", **REACH)


def check_against(kind: type[Plain], engine: str, task: str, iterations: int = 1, **settings: Any) -> None:
    if callable(settings.get("model")):
        settings["model"] = settings["model"]()
    plan = MPPI(task, engine=engine, seed=5, iterations=iterations, **settings)
    plain = kind(task, engine=engine, **settings)
    # the numbers depend on the seed and on how many came before: a twin shows those of every iteration
    twin = MPPI(task, seed=5, samples=plan.samples, horizon=plan.horizon, iterations=1)
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
        shift = (1, 1, 2, 0, 1)[call]
        action = plan(state, shift=shift)
        assert np.array_equal(plan.standard_noise.numpy(), noises[-1])
        plain(state, noises, shift)
        if task == "hopper" and call == 0:
            steps = {plain.ended[:, k].argmax() for k in plain.ended.any(axis=0).nonzero()[0]}
            assert len(steps) > 1 and not plain.ended.all(axis=0).any(), "they should end at different times"
        assert torch.equal(action, plan.actions[0])
        np.testing.assert_allclose(plan.sampled, plain.sampled, atol=2e-6, err_msg=f"samples of call {call}")
        np.testing.assert_allclose(plan.returns, plain.returns, atol=5e-5, rtol=5e-6, err_msg=f"returns of call {call}")
        np.testing.assert_allclose(plan.weights, plain.weights, atol=1e-4, err_msg=f"weights of call {call}")
        np.testing.assert_allclose(plan.actions, plain.actions, atol=2e-4, err_msg=f"plan of call {call}")
        summary = plan.summary
        assert summary["best_return"] == pytest.approx(plain.returns.max(), rel=1e-4)
        assert summary["mean_return"] == pytest.approx(plain.returns.mean(), rel=1e-4)
        assert summary["effective_samples"] == pytest.approx(1 / (plain.weights**2).sum(), rel=1e-2)
        assert summary["failed_samples"] == 0
        plain.actions = plan.actions.double().numpy()  # else low temperatures make differences grow from call to call
        plant.step(action[None])
    assert len(starts) == 5


def test_termination_matters() -> None:
    """A hopper that falls earns less where its samples stop at their ends than where they go on."""
    plant = lw.make("hopper")
    state = falling_hopper(plant)
    stop, ignore = (MPPI(seed=1, **HOPPER | dict(termination=word)) for word in ("stop", "ignore"))
    stop(state), ignore(state)
    assert torch.equal(stop.sampled, ignore.sampled)
    assert not torch.allclose(stop.returns, ignore.returns, atol=0.1)
    value = MPPI(seed=1, **HOPPER | dict(value=lambda obs: torch.full((len(obs),), 100.0)))
    value(state)
    gained = (value.returns - stop.returns).round().tolist()
    assert set(gained) == {0.0, 100.0}, "the value belongs to those that did not end, and to no other"


# seeds and weights


def numbers(plan: MPPI, state: torch.Tensor, calls: int = 4) -> list[torch.Tensor]:
    """Everything that a few plans in a row tell."""
    result = []
    for _ in range(calls):
        result.append(plan(state))
        result += [getattr(plan, name).clone() for name in BUFFERS]
    return result


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_seeds_and_resets() -> None:
    """The same seed plans the same to the bit, another one something else, and reset begins again."""
    plan, twin, other = (MPPI("reach", seed=seed, horizon=8, samples=10) for seed in (4, 4, 5))
    _, state = reached(0)
    first = numbers(plan, state)
    assert same(first, numbers(twin, state))
    for a, b in zip(first, numbers(other, state), strict=True):
        assert not torch.equal(a, b) or not a.any()  # the first plan starts from zeros
    assert not same(first, numbers(plan, state)), "without a reset, plans and noise go on"
    plan.reset()
    assert not plan.actions.any()
    assert same(first, numbers(plan, state))
    plan.reset(5)
    other.reset()
    assert same(numbers(plan, state), numbers(other, state))
    assert numbers(plan, state, 1)[0].data_ptr() != plan.actions.data_ptr(), "an action changes with the next plan"


# weights


def test_weights_add_up_to_one() -> None:
    for temperature in (0.01, 1.0, 100.0):
        plan = MPPI("reach", temperature=temperature)
        plan(reached(0)[1])
        assert plan.weights.sum().item() == pytest.approx(1, abs=1e-5) and (plan.weights >= 0).all()


def test_temperature() -> None:
    """A low one follows the best sample, a high one averages all."""
    state = reached(0)[1]
    for temperature in (1e-6, 1e-30):
        plan = MPPI("reach", temperature=temperature)
        plan(state)
        best = plan.returns.argmax()
        assert plan.weights[best] == 1 and plan.weights.sum() == 1
        assert torch.equal(plan.actions, plan.sampled[:, best])
        assert plan.summary["effective_samples"] == pytest.approx(1)
    for temperature in (1e9, 1e60, np.inf):
        plan = MPPI("reach", temperature=temperature)
        plan(state)
        torch.testing.assert_close(plan.actions, plan.sampled.mean(1))
        assert plan.summary["effective_samples"] == pytest.approx(plan.samples)
    # in between, what counts is the difference of two returns over the temperature
    plan = MPPI("reach", temperature=3.0)
    plan(state)
    ratio = ((plan.returns[0] - plan.returns[1]) / 3.0).exp()
    torch.testing.assert_close(plan.weights[0] / plan.weights[1], ratio, rtol=1e-4, atol=0)


# a task of the tests' own: a ball on a rail, whose reward is not a number where its action is above one half


RAIL = """
<mujoco>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor joint="x" gear="{}" {}/></actuator>
</mujoco>
"""


@wp.struct
class Rail:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class RailParams:
    dt: float
    limit: float = 0.5
    wrong: float = wp.inf  # divided by itself


@wp.func
def observe_rail(s: Rail, p: RailParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qvel[0]


@wp.func
def picky(s0: Rail, action: Row[float], s1: Rail, p: RailParams) -> float:
    if action[0] > p.limit:
        return p.wrong / p.wrong
    return action[0]


class Picky(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(RAIL.format(1, "")))
    obs = {"x": 1, "v": 1}
    World = Rail
    Params = RailParams
    observe, reward = observe_rail, picky


def unlimited(gear: float) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(RAIL.format(gear, ""))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("how", ["reward", "physics", "value"])
def test_failed_samples_count_for_nothing(how: str, engine: str) -> None:
    """A reward or value that is not a number, or a roll-out that diverges: the plan is made of the others."""
    settings: dict[str, Any] = dict(horizon=4, samples=40, smoothing=(1, 0, 0), temperature=1.0, engine=engine)
    if how == "physics":
        # motors so strong that only small actions keep MuJoCo's accelerations, and Warp's velocities, under 1e10
        settings |= dict(noise=1.0, limit=1e9, model=unlimited({"mujoco": 1e10, "warp": 2.5e12}[engine]))
    elif how == "value":
        settings |= dict(noise=1.0, limit=1e9, value=lambda obs: torch.where(obs[:, 0] > 0, torch.nan, 1.0))
    else:
        settings |= dict(noise=0.3)
    plan = MPPI(Picky, **settings)
    for _ in range(4):
        state = plan.state_of()
        plan(state)
        bad = torch.isinf(plan.returns)
        assert 0 < bad.sum() < 40, "all or none failed: nothing was tested"
        if how == "reward":
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
def test_when_all_samples_fail_the_plan_moves_on(engine: str) -> None:
    """It is the old one, moved forward; and once there are good samples again, nothing is left of the trouble."""
    plan = MPPI(Picky, engine=engine, horizon=5, samples=8, noise=0.1, limit=10.0, seed=3)
    plan(plan.state_of())
    for _ in range(3):
        old = plan.actions.clone()
        plan.env.set_params(limit=-10.0)
        action = plan(plan.state_of())
        assert torch.equal(plan.actions, torch.cat([old[1:], torch.zeros(1, 1)]))
        assert torch.equal(action, old[1]) and not plan.weights.any()
        assert plan.summary["failed_samples"] == 8 and plan.summary["best_return"] == -np.inf
        plan.env.set_params(limit=10.0)
        plan(plan.state_of())
        assert plan.summary["failed_samples"] == 0 and torch.isfinite(plan.actions).all()


def test_a_world_with_parameters_of_its_own() -> None:
    """Samples of many models at once: half of the worlds refuse what the others take."""
    plan = MPPI(Picky, horizon=3, samples=6, noise=0.1, limit=np.array([-9.0, 9.0] * 3))
    plan(plan.state_of())
    assert torch.isinf(plan.returns).tolist() == [True, False] * 3


# bounds and the plan's end


def test_actions_stay_within_bounds() -> None:
    plan = MPPI("reach", noise=10.0, temperature=1e-3)
    low, high = (torch.from_numpy(bound) for bound in (plan.env.action_space.low, plan.env.action_space.high))
    plant, _ = reached(1)
    for _ in range(4):
        plant.step(plan(plant.get_state()[0])[None])
        assert (plan.sampled >= low).all() and (plan.sampled <= high).all()
        assert (plan.actions >= low).all() and (plan.actions <= high).all()
        at_bounds = (plan.sampled == low) | (plan.sampled == high)
        assert at_bounds.float().mean() > 0.5
    free = MPPI(Picky, noise=10.0, horizon=4, limit=1e9)
    free(free.state_of())
    assert free.sampled.abs().max() > 10


@pytest.mark.parametrize("fill", ["zero", "repeat", [0.5, -0.25]])
def test_plans_move_forward(fill: Any) -> None:
    """By as many steps as have passed, and even past their end."""
    H = 6
    plan = MPPI("point_mass", horizon=H, samples=5, fill=fill)
    end = torch.tensor(fill) if isinstance(fill, list) else torch.zeros(2)
    assert torch.equal(plan.actions, end.expand(H, 2)), "the plan at first"
    plan(plan.state_of())
    for shift in (None, 0, 1, 3, H, H + 5):
        old = plan.actions.clone()
        plan(plan.state_of(), **({} if shift is None else {"shift": shift}))
        steps = 1 if shift is None else shift
        last = old[-1] if fill == "repeat" else end
        expected = torch.cat([old[min(steps, H) :], last.expand(min(steps, H), 2)])
        assert torch.equal(plan.nominal, expected), f"shift={shift}"
    for shift in (-1, 0.5, "a"):
        with pytest.raises(ValueError, match="shift must be a whole number from 0"):
            plan(plan.state_of(), shift=shift)


def test_zero_beyond_the_bounds_fills_with_the_nearest_action() -> None:
    model = mujoco.MjSpec.from_string(RAIL.format(1, 'ctrllimited="true" ctrlrange="0.2 0.4"'))
    for fill, filled in (("zero", 0.2), ([9.0], 0.4), ([0.25], 0.25)):
        plan = MPPI(Picky, horizon=3, model=model, fill=fill)
        torch.testing.assert_close(plan.actions, torch.full((3, 1), filled))


def test_iterations_improve_the_same_step() -> None:
    """Several improvements move the plan forward once, and end better than one does."""
    _, state = reached(0)
    results = []
    for iterations in (1, 8):
        plan = MPPI("reach", iterations=iterations, noise=0.3)
        plan(state)
        results.append(plan.summary["mean_return"])
    assert results[1] > results[0] + 1
    plan = MPPI("point_mass", horizon=5, iterations=3, noise=1e-6, temperature=1e9)
    plan.actions.copy_(torch.linspace(0, 0.9, 10).view(5, 2))
    old = plan.actions.clone()
    plan(plan.state_of())
    torch.testing.assert_close(plan.actions, torch.cat([old[1:], torch.zeros(1, 2)]), atol=1e-5, rtol=0)
