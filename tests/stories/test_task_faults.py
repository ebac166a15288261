import mujoco
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

XML = """
<mujoco><option timestep="0.01"/><worldbody>
<body name="box"><joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="push" joint="x" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>
"""


@wp.struct
class World:
    time: float
    qpos: Row[float]
    qvel: Row[float]
    events: Row[float] = lw.memory()
    remembered: Row[float] = lw.memory()
    steps: Row[float] = lw.lasting_memory()
    body_mass: Row[float]
    dof_damping: Row[float]


@wp.struct
class Params:
    dt: float
    metric: float = 1.0
    remembered: float = 1.0
    lasting: float = 1.0
    damping: float = 1.0
    reward: float = 1.0
    seen: float = 1.0
    box: int = lw.body("box")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.body_mass[p.box] * p.seen


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return p.reward


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = p.metric
    if s1.time < 0.025:
        metrics[1] = 1.0


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.body_mass[p.box] = lw.uniform(rng, 3.0, 5.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.dof_damping[0] = p.damping


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    s.events[0] += 1.0


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.remembered[0] = p.remembered
    s1.steps[0] = s0.steps[0] + p.lasting


class Faulty(lw.Task):
    model, horizon = staticmethod(lambda: mujoco.MjSpec.from_string(XML)), 20
    obs = {"position": 1, "mass": 1}
    metrics = ("number", "early")


ENGINES = pytest.mark.parametrize("engine", ["mujoco", "warp"])


@ENGINES
def test_metric_that_the_task_does_not_write_is_zero(engine: str) -> None:
    env = lw.make(Faulty, nworld=2, engine=engine)
    found = []
    for _ in range(4):
        env.step()
        found.append(env.metrics["early"][0].item())
    assert found == [1.0, 1.0, 0.0, 0.0]
    assert env.episode_metrics["early"].tolist() == [2.0, 2.0]


@ENGINES
def test_a_non_finite_metric_does_not_enter_the_state(engine: str) -> None:
    env = lw.make(Faulty, nworld=2, engine=engine, metric=[1.0, 1.0])
    env.step()
    env.set_params(metric=[float("inf"), 1.0])
    env.step()
    assert torch.isinf(env.metrics["number"]).tolist() == [True, False]
    assert env.episode_metrics["number"].tolist() == [1.0, 2.0]
    env.set_state(env.get_state())
    assert not any(env.fault_counts.values())


@ENGINES
@pytest.mark.parametrize("name", ["remembered", "lasting"])
def test_non_finite_memory_causes_a_fault_in_its_world(name: str, engine: str) -> None:
    env = lw.make(Faulty, nworld=3, engine=engine)
    env.step()
    env.set_params(**{name: [1.0, float("inf"), 1.0]})
    env.step()
    assert [lw.Done(reason) for reason in env.done_reason.tolist()] == [0, lw.Done.NAN, 0]
    columns = env.state_space.parts["steps"]
    assert env.get_state()[:, columns].flatten().tolist() == [2.0, 1.0 if name == "lasting" else 2.0, 2.0]
    env.set_state(env.get_state())


@ENGINES
@pytest.mark.parametrize("extreme", [2e10, -1e30, float("inf")])
def test_rewards_and_observations_beyond_1e10_are_faults_of_their_world(extreme: float, engine: str) -> None:
    env = lw.make(Faulty, nworld=4, engine=engine, reward=[1.0, extreme, 1.0, 9e9], seen=[1.0] * 4)
    good = env.obs.clone()
    env.set_params(seen=[1.0, 1.0, extreme, 1e9])
    env.step()
    assert [lw.Done(reason) for reason in env.done_reason.tolist()] == [0, lw.Done.REWARD, lw.Done.OBSERVATION, 0]
    assert env.reward.tolist() == pytest.approx([1.0, 0.0, 0.0, 9e9])
    assert torch.equal(env.final_obs[1:3], good[1:3]) and env.truncated.tolist() == [False, True, True, False]
    assert env.fault_counts["reward"] == env.fault_counts["observation"] == 1
    assert env.obs.abs().max() < 1e10  # even if the first observation of an episode is too large


@ENGINES
def test_invalid_randomized_model_field_causes_a_fault_in_its_world(engine: str) -> None:
    env = lw.make(Faulty, nworld=3, engine=engine, damping=[1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="dof_damping of world 1 is -1 and must be 0 or more"):
        lw.make(Faulty, nworld=3, engine=engine, damping=[1.0, -1.0, 1.0])
    env.set_params(damping=[1.0, -1.0, 1.0])
    env.rand_reset()
    state = env.get_state()
    assert torch.equal(env.get_obs(state), env.obs)
    env.step()
    assert [lw.Done(reason) for reason in env.done_reason.tolist()] == [0, lw.Done.MODEL, 0]
    assert env.reward[1] == 0.0
    env.set_params(damping=[1.0, 1.0, 1.0])
    env.step()
    env.step()
    assert env.done_reason.tolist() == [0, 0, 0]
    assert env.fault_counts["model"] == 2


def test_state_of_uses_nominal_model_fields_by_default() -> None:
    plan = lw.MPPI(Faulty, samples=2, horizon=2)
    columns = plan.env.state_space.parts["body_mass"]
    assert plan.state_of(qpos=[0.0])[columns].tolist() == [0.0, 1.0]
    assert plan.state_of(body_mass=[0.0, 2.0])[columns].tolist() == [0.0, 2.0]


def test_physics_stay_in_double_precision_if_an_event_writes_memory() -> None:
    env = lw.make(Faulty, nworld=1, engine="mujoco", horizon=0)
    time = env.state_space.parts["time"]
    for _ in range(1000):
        env.step()
    assert env.get_state()[0, time].item() == pytest.approx(10.0, abs=1e-9)
