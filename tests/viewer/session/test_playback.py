import numpy as np
import pytest
import torch
from conftest import SharedEnv
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, reset, seek, set_backwards, set_ghosts, set_mode, step_by
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session


@pytest.fixture(scope="module")
def trajectories() -> list[lw.Trajectory]:
    env = lw.make("point_mass", autoreset=False, horizon=20)
    return [lw.control(env, towards, seed=seed, steps=20 - 5 * seed) for seed in (0, 1)]


def test_playback_can_seek_reverse_and_loop(shared_env: SharedEnv, trajectories: list[lw.Trajectory]) -> None:
    env = shared_env("point_mass")
    session = Session(env, episodes=trajectories, paused=True)
    scene = session.stage.scene
    assert scene.modes == ("playback", "passive") and scene.episodes == ("episode 0", "episode 1")
    qpos = env.state_space.parts["qpos"]

    def shown() -> np.ndarray:
        return session.stage.frame().state[qpos]

    session.obey(command(seek, 7))
    np.testing.assert_array_equal(shown(), trajectories[0].states[7, qpos])
    session.obey(command(step_by, -2))
    assert session.stage.frame().status.step == 5
    session.obey(command(set_backwards, True))
    session.stage.advance(6)
    assert session.stage.frame().status.step == 20
    session.obey(command(set_mode, "playback", episode=1))
    frame = session.stage.frame()
    assert frame.status.step == 15 and frame.status.steps == 15 and frame.status.episode == 1
    session.obey(command(set_backwards, False))
    session.obey(command(reset, random=False))
    session.stage.frame()
    session.stage.advance(3)
    points = session.stage.frame().points
    np.testing.assert_allclose(points[:, 2], trajectories[1].rewards[:3])
    session.obey(command(set_ghosts, Ghosts(burst=4)))
    ghosts = session.stage.frame().ghosts
    past = [ghost for ghost in ghosts if ghost.colour[0] > ghost.colour[2]]
    assert len(past) == 1 and len(ghosts) == 4


def test_worlds_continue_from_the_state_of_a_playback(shared_env: SharedEnv, trajectories: list[lw.Trajectory]) -> None:
    env = shared_env("point_mass")
    session = Session(env, episodes={"first": trajectories[0]}, paused=True)
    session.obey(command(seek, 20))
    session.obey(command(set_mode, "passive"))
    qpos = env.state_space.parts["qpos"]
    assert torch.equal(env.get_state()[0, qpos], trajectories[0].states[20, qpos])
    session.stage.advance()


def test_states_are_played_back_without_rewards(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass")
    states = torch.cat([env.get_state() for _ in range(4)])
    session = Session(env, episodes=states)
    session.stage.advance()
    frame = session.stage.frame()
    assert frame.status.steps == 3 and np.isnan(frame.points[:, 2:]).all()


def test_episode_of_another_task_or_model_raises_an_error(
    shared_env: SharedEnv, trajectories: list[lw.Trajectory]
) -> None:
    env = lw.make("point_mass", dynamics=["body_mass"])
    for worlds, episodes, message in (
        (
            shared_env("hopper"),
            trajectories,
            "episode 0 is an episode of the task 'point_mass', not of the task 'hopper'",
        ),
        (env, trajectories[0], "episode 0 does not fit the current task 'point_mass'"),
        (shared_env("hopper"), torch.zeros(3, 4), "or states of shape"),
    ):
        with pytest.raises(ValueError, match=message):
            Session(worlds, episodes=episodes)
    with pytest.raises(FileNotFoundError, match="missing.npz"):
        Session(shared_env("hopper"), episodes=["missing.npz"])
