"""What each command does."""

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from memory_window import pushing

import lyceum_warp as lw
from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import Perturb, StepBy
from lyceum_warp.viewer.session.clock import Session


def pushed(env: lw.Env, world: int) -> bool:
    return bool(env.get_state()[world, env.state_space.parts["xfrc_applied"]].any())


@pytest.fixture
def push(shared_env: SharedEnv) -> Perturb:
    forces = np.zeros((shared_env("hopper", nworld=2).model.nbody, 6))
    forces[1, 0] = 50.0
    return Perturb(forces)


def released(push: Perturb) -> Perturb:
    return Perturb(0 * push.forces)


def test_a_push_ends_when_another_world_is_shown(shared_env: SharedEnv, push: Perturb) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True)
    session.obey(push)
    assert pushed(env, 0)
    session.obey(protocol.SetWorld(1))
    assert not pushed(env, 0)
    session.obey(push)  # the drag goes on
    session.obey(released(push))
    assert not pushed(env, 0) and not pushed(env, 1)


def test_a_push_of_the_past_does_not_stay(shared_env: SharedEnv, push: Perturb) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, controllers={"policy": pushing, "other": pushing}, paused=True)
    qpos = env.model.qpos0 + 0.1

    def past_push() -> None:
        session.obey(push)
        session.obey(StepBy(4))
        session.obey(released(push))
        session.obey(StepBy(2))
        session.obey(StepBy(-4))
        assert pushed(env, 0)

    placed = Perturb(0 * push.forces, qpos=qpos)
    branches = (placed, protocol.SetMode("passive"), protocol.SetController("other"), protocol.SetWorld(1))
    for branch in branches:  # each of them drops the steps ahead
        past_push()
        session.obey(branch)
        assert not pushed(env, 0), branch
        session.obey(protocol.Reset(random=False))
        session.obey(protocol.SetWorld(0))
        session.obey(protocol.SetController("policy"))
    past_push()
    session.obey(StepBy(3))
    assert not pushed(env, 0)


def test_a_push_that_ends_in_the_past_does_not_stay_in_the_present(shared_env: SharedEnv, push: Perturb) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True)
    session.stage.advance(2)
    session.obey(push)
    session.stage.advance(2)
    session.obey(StepBy(-4))
    session.obey(released(push))
    session.obey(StepBy(2))
    assert pushed(env, 0)  # the push is repeated
    session.obey(StepBy(2))
    assert not pushed(env, 0) and session.stage.live.past.ahead == 0


def test_a_push_goes_on_under_another_controller(push: Perturb) -> None:
    env = lw.make("hopper", nworld=2)
    seen = []

    def look(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        seen.append(state[env.state_space.parts["xfrc_applied"]].abs().max().item())
        return torch.zeros(3)

    session = Session(env, controllers={"look": look}, paused=True)
    session.obey(protocol.SetMode("passive"))
    session.obey(push)
    session.obey(protocol.SetController("look"))
    assert pushed(session.stage.live.env, 0) and not pushed(env, 0)
    session.stage.advance(2)
    assert seen == [0.0, 0.0]
    session.obey(released(push))
    assert not pushed(session.stage.live.env, 0)


def test_a_body_is_placed_while_paused(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True, world=1)
    session.stage.advance(2)
    before = env.get_state()
    qpos = before[1, env.state_space.parts["qpos"]].numpy().copy()
    qpos[1] += 0.5
    session.obey(Perturb(np.zeros((env.model.nbody, 6)), qpos=qpos))
    np.testing.assert_array_equal(session.stage.frame().pose.qpos, qpos)
    assert torch.equal(env.get_state()[0], before[0])


def test_seeking_shows_a_step_of_the_episode(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, seed=0)
    session.stage.advance(8)
    session.obey(protocol.Seek(3))
    frame = session.stage.frame()
    assert frame.status.step == 3 and frame.status.paused and frame.status.seekable == (0, 8)
    session.obey(protocol.Seek(100))
    assert session.stage.frame().status.step == 8


def test_another_controller_acts_after_steps_back(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, controllers={"a": pushing, "b": lambda obs: 0.5 * pushing(obs)}, paused=True, seed=1)
    session.stage.advance(6)
    session.obey(StepBy(-4))
    session.obey(protocol.SetController("b"))
    assert session.stage.live.past.ahead == 0 and session.stage.live.past.behind == 2
    session.obey(StepBy(1))
    assert env.action.abs().max() == 0.25
    session.obey(StepBy(-1))
    session.obey(protocol.SetMode("passive"))
    session.obey(StepBy(1))
    assert env.action.abs().max() == 0


def test_worlds_are_chosen_by_number_and_by_return(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=4)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=0)
    session.obey(protocol.SetWorld("last_ended"))
    assert session.stage.frame().messages == ("no episode has ended yet",)
    total = torch.zeros(4, dtype=torch.float64)
    ended: set[int] = set()
    while not ended or session.stage.live.made < 60:
        session.stage.advance()
        total += env.reward
        if env.done.any():
            ended = set(env.done.nonzero().flatten().tolist())
        total[env.done] = 0.0
    for choice, expected in (("best", total.argmax()), ("worst", total.argmin()), (2, 2), ("next", 3), ("next", 0),
                             ("previous", 3)):  # fmt: skip
        session.obey(protocol.SetWorld(choice))
        frame = session.stage.frame()
        assert frame.status.world == int(expected), choice
        np.testing.assert_array_equal(frame.state, env.get_state()[int(expected), : len(frame.state)].numpy())
    session.obey(protocol.SetWorld("last_ended"))
    assert session.stage.frame().status.world in ended
    session.obey(protocol.SetWorld(4))
    assert session.stage.frame().messages == ("there is no world 4: there are 4 worlds, 0 to 3",)


def test_controllers_are_switched_and_passive_worlds_have_no_controls(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, controllers={"push": pushing, "half": lambda obs: 0.5 * pushing(obs)}, paused=True)
    assert session.stage.scene.modes == ("controller", "passive") and session.stage.frame().status.controller == "push"
    session.stage.advance()
    assert env.action.abs().max() == 0.5
    session.obey(protocol.SetController("half"))
    session.stage.advance()
    assert env.action.abs().max() == 0.25 and session.stage.frame().status.controller == "half"
    session.obey(protocol.SetMode("passive"))
    session.stage.advance()
    assert env.action.abs().max() == 0 and session.stage.frame().status.controller is None
    session.obey(protocol.SetController("none"))
    assert session.stage.frame().messages == ("there is no controller 'none': there are push, half",)
    session.obey(protocol.SetMode("playback"))
    assert "there is no mode 'playback' here" in session.stage.frame().messages[0]
