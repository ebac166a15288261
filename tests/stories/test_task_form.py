from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from form_tasks import Drawn, Gifted, PuckParams, PuckWorld
from full_task import Full

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.env import OpenLoop

ENGINES = ["mujoco", "warp"]


@wp.func
def copied(s: PuckWorld, action: Row[float], p: PuckParams, ctrl: Row[float]):
    ctrl[0] = action[0]


class DrawnWithControl(Drawn):
    """Because of ``control``, rollouts run step by step."""

    control = copied


def random_actions(env: lw.Env, steps: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2.0 * torch.rand(steps, *env.action.shape, generator=generator) - 1.0


def step_without_events(env: lw.Env, action: torch.Tensor) -> None:
    env.action.copy_(action)
    for phase in env.worlds.step_phases():
        if not phase.name.startswith("event"):
            phase.run()


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_model_fields_can_be_set_in_an_environment_of_any_task(engine: str) -> None:
    env = lw.make("hopper", nworld=3, engine=engine, dynamics=["body_mass", "geom_friction"], horizon=0)
    masses = env.field("body_mass").clone()
    assert torch.equal(masses, torch.tensor(env.model.body_mass).float().expand(3, -1))
    assert torch.equal(env.field("body_mass", "torso"), masses[:, 1:2])
    env.reset()
    masses[1, 1] *= 3.0
    env.set_dynamics(body_mass=masses)
    assert torch.equal(env.field("body_mass"), masses)
    friction = torch.full((5, 3), 0.5)
    env.set_dynamics(torch.tensor([False, False, True]), geom_friction=friction)
    assert torch.equal(env.field("geom_friction")[2], friction)
    assert torch.equal(env.field("geom_friction")[0], torch.tensor(env.model.geom_friction).float())
    for _ in range(3):
        env.step(torch.full((3, 3), 0.5))
    qpos = env.field("qpos")
    assert torch.equal(qpos[0, 1], qpos[2, 1])
    assert not torch.equal(qpos[0], qpos[1])
    env.rand_reset()
    assert torch.equal(env.field("body_mass"), masses)
    state = env.get_state()
    assert torch.equal(state[:, env.state_space.parts["body_mass"]].float(), masses)
    other = env.replicate(nworld=3)
    assert torch.equal(other.field("body_mass")[1], other.field("body_mass")[0])
    other.set_state(state)
    assert torch.equal(other.field("body_mass"), masses)


def test_startup_draws_lasting_memory_once_per_world_and_seed() -> None:
    env = lw.make(Gifted, nworld=8, seed=3)
    drawn = env.obs[:, 1].clone()
    assert drawn.unique().numel() == 8 and (drawn >= 1).all() and (drawn < 2).all()
    env.rand_reset()
    assert torch.equal(env.obs[:, 1], drawn)
    env.rand_reset(seed=4)
    assert not torch.isin(env.obs[:, 1], drawn).any()
    env.rand_reset(seed=3)
    assert torch.equal(env.obs[:, 1], drawn)
    plan = lw.MPPI(Gifted, samples=4, horizon=2)
    assert plan.env.obs[0, 1] >= 1 and plan.state_of()[plan.env.state_space.parts["practice"]].tolist() == [0.0]


@pytest.mark.quick("Drawn-mujoco", "DrawnWithControl-mujoco")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", [Drawn, DrawnWithControl])
def test_a_rollout_uses_the_model_in_the_state_or_the_nominal_model(task: type[lw.Task], engine: str) -> None:
    env = lw.make(task, nworld=3, engine=engine, autoreset=False, horizon=0, seed=4)
    state, actions = env.get_state()[1], random_actions(env, 4)
    nominal = env.state_space.split(state.clone())
    for name in ("body_mass", "geom_friction", "gravity"):
        own = env.model.opt.gravity if name == "gravity" else getattr(env.model, name)
        nominal[name].copy_(torch.from_numpy(np.asarray(own, dtype=np.float32)).double().ravel())
    plain = torch.cat(list(nominal.values()))
    assert not torch.equal(plain, state)

    def rewards(start: torch.Tensor, **options: Any) -> torch.Tensor:
        loop = OpenLoop(lw.make(task, nworld=3, engine=engine, autoreset=False, seed=9), 4, **options)
        for _ in range(3):  # the third call replays graphs
            loop.state.copy_(start)
            loop.actions.copy_(actions)
            loop.run()
        assert not loop.fault.any()
        return loop.reward.clone()

    def stepped(start: torch.Tensor) -> torch.Tensor:
        env.set_state(start.expand(3, -1).contiguous())
        found = []
        for action in actions:
            env.step(action)
            found.append(env.reward.clone())
        return torch.stack(found)

    assert torch.equal(rewards(state), stepped(state))
    assert torch.equal(rewards(state, nominal_model=True), stepped(plain))
    assert not torch.equal(stepped(plain), stepped(state))


@pytest.mark.parametrize("nominal", [False, True])
def test_a_planner_uses_the_model_in_the_state_unless_nominal_model_is_set(nominal: bool) -> None:
    light, heavy = (lw.MPPI(Drawn, samples=8, horizon=4, nominal_model=nominal) for _ in range(2))
    state = light.state_of()
    light(state)
    heavy(light.state_of(body_mass=1.5 * state[light.env.state_space.parts["body_mass"]]))
    assert torch.equal(light.returns, heavy.returns) == nominal


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ENGINES)
def test_a_rollout_equals_steps_without_events(engine: str) -> None:
    env = lw.make(Full, nworld=3, engine=engine, autoreset=False, horizon=0)
    loop = OpenLoop(lw.make(Full, nworld=3, engine=engine, autoreset=False, seed=5), 4)
    for action in random_actions(env, 3, seed=1):
        env.step(action)
    state, actions = env.get_state()[1], random_actions(env, 4)
    for _ in range(3):
        loop.state.copy_(state)
        loop.actions.copy_(actions)
        loop.run()
        env.set_state(state.expand(3, -1).contiguous())
        for t, action in enumerate(actions):
            step_without_events(env, action)
            assert torch.equal(loop.reward[t], env.reward), f"step {t}"
        assert loop.final_obs_groups.keys() == {"policy", "critic"}
        for name, obs in loop.final_obs_groups.items():
            assert torch.equal(obs, env.final_obs_groups[name]), name
    changed = torch.zeros_like(env.done)
    for action in random_actions(env, 12):
        env.step(action)
        changed |= env.worlds.changed_view
    assert changed.any(), "there were no events to leave out"


@pytest.mark.parametrize("engine", ENGINES)
def test_controls_of_a_task_are_clipped_to_their_ranges(engine: str) -> None:
    env = lw.make(Full, engine=engine)
    env.step(torch.tensor([[3.0, 0.0, 0.0]]))
    assert env.field("ctrl").item() == 1.0


def test_invalid_dynamics_raise_an_error_and_change_nothing() -> None:
    with pytest.raises(ValueError, match="there is no field 'body_mas': did you mean body_mass"):
        lw.make("hopper", dynamics=["body_mas"])
    env = lw.make("hopper", nworld=2, dynamics=["body_mass"])
    state = env.get_state()
    for fields, message in (
        ({"body_mass": torch.ones(3)}, r"body_mass must be numbers of shape \(2, 5\), or \(5,\) for all worlds, not "),
        ({"body_mass": "heavy"}, "body_mass must be numbers of shape"),
        ({"body_mass": -torch.ones(2, 5)}, r"body_mass\[0\] of world 0 is -1 and must be 0 or more"),
        ({"body_mass": torch.full((5,), torch.nan)}, r"body_mass\[0\] of world 0 is nan"),
        ({"body_mas": 1.0}, "there is no field 'body_mas'"),
        ({"geom_friction": 1.0}, r"the model field 'geom_friction' is the same in every world .*dynamics=\['geom_fric"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            env.set_dynamics(**fields)
        assert "\n" not in str(caught.value)
        assert torch.equal(env.get_state(), state)
    with pytest.raises(ValueError, match="the task 'hopper' has no group 'critic' of observations: it has"):
        env.get_obs(group="critic")
