import numpy as np
import torch
from conftest import SharedEnv

from lyceum_warp.viewer.commands import command, drive, reset, set_world
from lyceum_warp.viewer.session.clock import Session


def test_command_of_the_user_is_observed_until_it_is_released(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=2)
    session = Session(env, paused=True, seed=0)
    stage, velocity = session.stage, (0.5, -0.25, 0.125)
    assert stage.scene.speeds == (1.0, 1.0, 0.5)
    drawn = env.get_obs()[0, 45:]
    np.testing.assert_allclose(stage.frame().status.command, drawn, atol=1e-5)
    session.obey(command(drive, velocity))
    for _ in range(2):
        stage.advance(3)
        status = stage.frame().status
        assert status.driven and np.allclose(status.command, velocity)
        np.testing.assert_allclose(env.obs[0, 45:], velocity)
        session.obey(command(reset, random=True))
        stage.frame()
    for end in (command(drive, None), command(set_world, 1)):
        session.obey(command(drive, velocity))
        session.obey(end)
        stage.advance(2)
        assert not stage.frame().status.driven
        assert not torch.allclose(env.obs[0, 45:], torch.tensor(velocity))


def test_arrows_show_the_commanded_and_the_measured_velocity(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=2)
    stage = Session(env, paused=True, seed=0).stage
    stage.driving.velocity = (1.0, 0.0, 0.5)
    state, parts = env.get_state()[0], env.state_space.parts
    for name, values in (("qpos", [1, 2, 0.3, 0.5**0.5, 0, 0, 0.5**0.5]), ("qvel", [0, 0.5, 0, 0, 0, -1])):
        state[parts[name]][: len(values)] = torch.tensor(values, dtype=torch.float64)
    stage.live.set_row(state)
    stage.frame()
    ways = [arrow.end - arrow.start for arrow in stage.frame().arrows]
    expected = [[0, 0.4, 0], [0, 0.2, 0], [0, 0, 0.2], [0, 0, -0.4]]
    np.testing.assert_allclose(ways, expected, atol=1e-6)


def test_driving_outside_a_velocity_task_shows_a_message(shared_env: SharedEnv) -> None:
    session = Session(shared_env("hopper", nworld=2), paused=True)
    session.obey(command(drive, (1.0, 0.0, 0.0)))
    frame = session.stage.frame()
    assert "cannot be driven" in frame.messages[0] and frame.arrows == () and frame.status.command is None
