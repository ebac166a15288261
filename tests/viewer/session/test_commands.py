from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv
from memory_window import pushing

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, perturb, reset, set_mode, set_number, set_world
from lyceum_warp.viewer.session.clock import Session

PULL = {"select": 1, "active": int(mujoco.mjtPertBit.mjPERT_TRANSLATE), "localmass": 4.0, "refselpos": [0.3, 0.0, 1.25]}
PUSH, RELEASE = command(perturb, PULL), command(perturb, {})


def test_push_moves_the_displayed_world_until_it_is_released(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True)
    force, qpos = env.state_space.parts["xfrc_applied"], env.state_space.parts["qpos"]
    for each, moved in ((PUSH, 0), (command(set_world, 1), None), (PUSH, 1), (RELEASE, None)):
        session.obey(command(reset, random=False))
        before = env.get_state()
        env.reset()
        session.obey(each)
        session.stage.advance(2)
        after = env.get_state()
        assert not after[:, force].any() and not before[:, force].any()
        x = after[:, qpos][:, 0]
        assert (x > 1e-3).tolist() == [world == moved for world in range(2)]


def test_one_pull_holds_a_body_until_it_is_released(shared_env: SharedEnv) -> None:
    """Even a page that draws a picture per second must not make the body swing."""
    env = shared_env("hopper", nworld=1, autoreset=False)
    session = Session(env, paused=True)
    session.obey(PUSH)
    session.stage.advance(100)
    for _ in range(100):
        session.stage.advance()
        assert env.field("qpos")[0, 0].item() == pytest.approx(0.3, abs=0.1)


def test_state_for_a_controller_excludes_the_push() -> None:
    env = lw.make("hopper", nworld=2)
    seen = []

    def look(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        seen.append(state[env.state_space.parts["xfrc_applied"]].abs().max().item())
        return torch.zeros(3)

    session = Session(env, controllers={"look": look}, paused=True)
    for each in (command(set_mode, "passive"), PUSH, command(set_mode, "controller", "look")):
        session.obey(each)
    plant = session.stage.live.env
    position = plant.get_state()[0, plant.state_space.parts["qpos"]][0].item()
    session.stage.advance(2)
    assert seen == [0.0, 0.0]
    assert plant.get_state()[0, plant.state_space.parts["qpos"]][0] > position


def test_body_can_be_placed_while_paused(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True)
    session.obey(command(set_world, 1))
    session.stage.advance(2)
    before = env.get_state()
    qpos = before[1, env.state_space.parts["qpos"]].numpy().copy()
    qpos[1] += 0.5
    session.obey(command(perturb, {}, qpos=qpos))
    np.testing.assert_array_equal(session.stage.frame().state[env.state_space.parts["qpos"]], qpos)
    assert torch.equal(env.get_state()[0], before[0])


def test_worlds_are_chosen_by_number_and_by_return(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=4)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=0)
    total = torch.zeros(4, dtype=torch.float64)
    for _ in range(60):
        session.stage.advance()
        total += env.reward
        total[env.done] = 0.0
    for choice, expected in (("best", total.argmax()), ("worst", total.argmin()), (2, 2), ("next", 3), ("next", 0),
                             ("previous", 3)):  # fmt: skip
        session.obey(command(set_world, choice))
        frame = session.stage.frame()
        assert frame.status.world == int(expected), choice
        np.testing.assert_array_equal(frame.state, env.get_state()[int(expected), : len(frame.state)].numpy())
    session.obey(command(set_world, 4))
    assert session.stage.frame().messages == ("there is no world 4: there are 4 worlds, numbered from 0",)


def test_set_mode_selects_a_controller_or_zero_actions(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    half: Callable[[torch.Tensor], torch.Tensor] = lambda obs: 0.5 * pushing(obs)  # noqa: E731
    session = Session(env, controllers={"push": pushing, "half": half}, paused=True)
    assert session.stage.scene.modes == ("controller", "passive")
    for each, name, action in (
        (command(set_mode, "controller"), "push", 0.5), (command(set_mode, "controller", "half"), "half", 0.25),
        (command(set_mode, "passive"), None, 0.0),
    ):  # fmt: skip
        session.obey(each)
        session.stage.advance()
        assert env.action.abs().max() == action and session.stage.frame().status.controller == name


def test_planner_continues_with_changed_settings() -> None:
    env = lw.make("reach", autoreset=False, nthread=1)
    session = Session(env, controllers={"mppi": lw.MPPI("reach", samples=8)}, seed=0, paused=True)
    stage = session.stage
    stage.advance()
    assert dict(stage.frame().status.planner) == {"noise": 1.0, "temperature": 0.2, "horizon": 16, "samples": 8}
    for name, value in (("noise", 0.5), ("samples", 12), ("horizon", 10)):
        session.obey(command(set_number, "planner", name, value))
    config = stage.controllers["mppi"].controller.config  # type: ignore[union-attr]
    assert (config.noise, config.samples, config.horizon, config.temperature) == (0.5, 12, 10, 0.2)
    stage.advance()
    session.obey(command(set_number, "planner", "temperature", -1.0))
    assert "temperature" in stage.frame().messages[-1]
    stage.advance()
    stage.close()


def test_changed_reward_weight_applies_to_all_worlds() -> None:
    env = lw.make("hopper", nworld=2)
    session = Session(env, seed=0, paused=True)
    state = env.get_state()
    env.step(torch.ones(2, 3))
    before = env.reward.clone()
    name = "ctrl_cost_weight"
    value = dict(session.stage.frame().status.params)[name]
    session.obey(command(set_number, "task", name, value + 1.0))
    assert dict(session.stage.frame().status.params)[name] == value + 1.0
    env.set_state(state)
    env.step(torch.ones(2, 3))
    torch.testing.assert_close(env.reward, before - 3.0)


def test_changed_physics_applies_to_the_displayed_world() -> None:
    env = lw.make("go1_velocity", nworld=2)
    session = Session(env, seed=0, paused=True)
    part = env.state_space.parts["geom_friction"]
    nominal, other = env.task.model.geom_friction.ravel(), env.get_state()[1, part].clone()
    session.obey(command(set_number, "physics", "geom_friction", 0.5))
    state = env.get_state()
    np.testing.assert_allclose(state[0, part], 0.5 * nominal, rtol=1e-6)
    assert torch.equal(state[1, part], other)
    assert dict(session.stage.frame().status.physics) == {"geom_friction": pytest.approx(0.5)}
