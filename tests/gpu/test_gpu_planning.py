from typing import Any

import pytest
import torch
import warp as wp
from rail_task import Picky
from test_gpu import CUDA, nothing_waits

import lyceum_warp as lw
from lyceum_warp import Row

pytestmark = pytest.mark.gpu

UPDATES: dict[str, dict[str, Any]] = {
    "mppi with knots": dict(knots=4, spline="linear", include_plan=True),
    "cem": dict(update="cem", elites=20),
    "cem with knots": dict(update="cem", knots=4, spline="linear"),
    "predictive sampling": dict(update="predictive_sampling", knots=4, spline="zero"),
}


@wp.func
def first_squared(obs: Row[float]) -> float:
    return 3.0 * obs[0] * obs[0]


PLANNERS: dict[str, dict[str, Any]] = UPDATES | {
    "mppi": {},
    "mppi in three iterations": dict(iterations=3),
    "cem in two iterations": dict(update="cem", elites=20, iterations=2),
    "a value in Warp": dict(value=first_squared),
    "a value in torch": dict(value=lambda obs: 3.0 * obs[:, 0] ** 2),
}


def plant(task: str) -> lw.Env:
    env = lw.make(task, autoreset=False)
    env.rand_reset(1)
    return env


@pytest.mark.parametrize("task, horizon", [("reach", 16), ("half_cheetah", 8), ("cartpole_swingup", 20)])
def test_plans_agree_with_plans_on_the_cpu(task: str, horizon: int) -> None:
    env = plant(task)
    gpu, cpu = (
        lw.MPPI(task, device=device, engine=engine, horizon=horizon, samples=30, temperature=10.0, seed=3)
        for device, engine in ((CUDA, "warp"), ("cpu", "mujoco"))
    )
    for _ in range(4):
        state = env.get_state()[0]
        action, other = gpu(state), cpu(state)
        torch.testing.assert_close(gpu.standard_noise.cpu(), cpu.standard_noise, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(gpu.returns.cpu(), cpu.returns, rtol=2e-2, atol=2e-2)
        torch.testing.assert_close(action.cpu(), other, rtol=1e-2, atol=1e-2)
        cpu.actions.copy_(gpu.actions)
        env.step(other[None])


@pytest.mark.parametrize("update", ["mppi with knots", "cem"])
def test_planner_for_several_plants_gives_the_plans_of_separate_planners(update: str) -> None:
    settings: dict[str, Any] = dict(task="reach", device=CUDA, engine="warp", samples=40, **UPDATES[update])
    states = lw.make("reach", nworld=5, autoreset=False, seed=3).get_state()
    together = lw.MPPI(**settings, seed=5, plants=5)
    alone = [lw.MPPI(**settings, seed=5 + i) for i in range(5)]
    for _ in range(3):
        actions = together(states)
        for i, plan in enumerate(alone):
            plan(states[i])
            torch.testing.assert_close(together.standard_noise[:, i], plan.standard_noise)
            torch.testing.assert_close(together.returns[i], plan.returns, rtol=1e-3, atol=1e-3)
            if torch.equal(together.returns[i], plan.returns):
                torch.testing.assert_close(actions[i].to(CUDA), plan.actions[0])
            plan.actions.copy_(together.actions[:, i])
            plan.knot_actions.copy_(together.knot_actions[:, i])
            if plan.adapted_noise is not None:
                plan.adapted_noise.copy_(together.adapted_noise[:, i])
    together.reset(where=torch.arange(5, device=CUDA) == 2)
    assert not together.actions[:, 2].any() and together.actions[:, 1].any()


@pytest.mark.parametrize("of_plants, of_plan", [(CUDA, "cpu"), ("cpu", CUDA)])
def test_actions_are_on_the_device_of_the_states(of_plants: str, of_plan: str) -> None:
    env = lw.make("point_mass", nworld=3, device=of_plants, engine="warp", autoreset=False, seed=1)
    plan = lw.MPPI("point_mass", plants=3, horizon=8, samples=32, device=of_plan, engine="warp")
    before = env.get_state()
    for _ in range(3):
        env.step(plan(env.get_state()))
    assert plan.actions.device.type == torch.device(of_plan).type
    assert not torch.equal(env.get_state(), before)


@pytest.mark.parametrize("update", UPDATES)
def test_equal_returns_give_equal_plan_updates_on_gpu_and_cpu(update: str) -> None:
    gpu, cpu = (
        lw.MPPI("reach", device=device, engine=engine, samples=200, seed=3, **UPDATES[update])
        for device, engine in ((CUDA, "warp"), ("cpu", "mujoco"))
    )
    state = plant("reach").get_state()[0]
    gpu(state), cpu(state)
    torch.testing.assert_close(gpu.sampled.cpu(), cpu.sampled, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gpu.returns.cpu(), cpu.returns, rtol=2e-2, atol=2e-2)
    weights = gpu.weights.cpu()
    if gpu.config.update != "mppi":
        count = gpu.config.elites or 1
        best = gpu.returns.cpu().argsort(descending=True, stable=True)[:count]
        assert weights.nonzero().ravel().tolist() == sorted(best.tolist())
    mean = torch.einsum("k,tki->ti", weights, gpu.sampled.cpu())
    torch.testing.assert_close(gpu.actions.cpu(), mean, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("planner", PLANNERS)
def test_plans_with_graphs_equal_plans_without_graphs(planner: str) -> None:
    env = plant("reach")
    replayed, direct = (
        lw.MPPI("reach", device=CUDA, engine="warp", deterministic=True, graphs=graphs, **PLANNERS[planner])
        for graphs in (True, False)
    )
    for shift in (1, 1, 2, 0):
        state = env.get_state()[0]
        assert torch.equal(replayed(state, shift=shift), direct(state, shift=shift))
        assert torch.equal(replayed.knot_actions, direct.knot_actions)
        env.step(replayed.actions[:1].cpu())


@pytest.mark.parametrize("planner", PLANNERS)
def test_plans_allocate_nothing_and_do_not_wait_for_the_device(planner: str) -> None:
    plan = lw.MPPI("reach", device=CUDA, engine="warp", samples=256, **PLANNERS[planner])
    state = plan.state_of(mocap_pos=[0.1, 0.1, 0.2])
    for _ in range(3):
        plan(state)
    memory = torch.cuda.memory_allocated(), wp.get_mempool_used_mem_current(CUDA)
    with nothing_waits():
        for _ in range(50):
            plan(state)
    assert (torch.cuda.memory_allocated(), wp.get_mempool_used_mem_current(CUDA)) == memory


class NegativeWeights(lw.PlanUpdate):
    def weigh(self, samples: lw.PlanSamples) -> None:
        samples.weights.fill_(-1.0)


def test_problems_of_plans_are_reported_without_waiting_for_the_device(caplog: pytest.LogCaptureFixture) -> None:
    words: dict[str, Any] = dict(device=CUDA, engine="warp", horizon=4, samples=16)
    failing = lw.MPPI(Picky, limit=-10.0, **words)
    wrong = lw.Planner(Picky, update=NegativeWeights(), **words)
    state = failing.state_of()
    for _ in range(3):
        failing(state)
    with nothing_waits():
        failing(state)
    torch.cuda.synchronize()
    for _ in range(3):
        failing(state)
    (message,) = caplog.messages
    assert message.startswith("all 16 samples of a plan of picky failed")
    with pytest.raises(ValueError, match="^weigh of NegativeWeights must .*: the weight of sample 0 is -1$"):
        for _ in range(3):
            wrong(state)
            torch.cuda.synchronize()
    assert not wrong.actions.any()


@pytest.mark.parametrize("samples", [8, 2048])
def test_a_value_function_moves_to_the_device_of_the_plans(samples: int) -> None:
    env = lw.make("hopper")
    for device in ("cpu", CUDA):
        value = lw.ValueFunction(env.obs_space.size, (8,), scale=1.0).to(device)
        plan = lw.MPPI("hopper", device=CUDA, horizon=2, samples=samples, nthread=1, value=value)
        assert plan.env.device.is_cpu == (samples == 8)
        assert torch.isfinite(plan(plan.state_of())).all()
