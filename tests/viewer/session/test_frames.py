import math

import numpy as np
import torch
from conftest import SharedEnv
from memory_window import pushing

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, reset, set_ghosts, set_mode, set_world, show_clip, step_by
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session


def test_other_worlds_and_past_states_are_drawn_transparently(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=4)
    session = Session(env, paused=True, seed=0)
    session.stage.advance(10)
    session.obey(command(set_world, 2))
    session.obey(command(set_ghosts, Ghosts(worlds=2, burst=5)))
    ghosts = session.stage.frame().ghosts
    state, qpos = env.get_state(), env.state_space.parts["qpos"]
    for ghost, world in zip(ghosts, (3, 0), strict=False):
        np.testing.assert_array_equal(ghost.state[qpos], state[world, qpos].numpy())
    past = ghosts[2:]
    assert len(past) == 5 and past[0].colour[3] > past[1].colour[3] and past[0].colour[0] > past[0].colour[2]
    np.testing.assert_array_equal(past[-1].state[qpos], session.stage.live.past.states[0, 2, qpos].numpy())
    session.obey(command(set_ghosts, Ghosts(worlds=3, grid=True)))
    shifts = {ghost.shift for ghost in session.stage.frame().ghosts}
    assert len(shifts) == 3 and (0.0, 0.0) not in shifts and all(g.colour is None for g in session.stage.frame().ghosts)
    session.obey(command(set_ghosts, Ghosts(worlds=9)))
    assert len(session.stage.frame().ghosts) == 3


def test_reference_of_a_clip_is_a_ghost_and_the_panel_moves_along_clips() -> None:
    env = lw.make("go1_tracking", nworld=2)
    session = Session(env, paused=True, seed=0)
    session.stage.advance(3)
    frame, parts = session.stage.frame(), env.state_space.split(env.get_state())
    (ghost,) = frame.ghosts
    table, qpos = env.task.params["clips"], env.state_space.parts["qpos"]
    np.testing.assert_allclose(ghost.state[qpos], table[int(parts["frame"][0, 0]), 2:])
    assert session.stage.scene.clips == (201, 201, 201, 201) and frame.status.clip is not None
    assert frame.status.clip[0] == -1
    session.obey(command(show_clip, 2, clip=2, frame=77))
    row = int(env.task.params["ranges"][2, 0]) + 77
    frame = session.stage.frame()
    assert frame.status.clip == (2, 2, 77)
    np.testing.assert_allclose(frame.state[qpos], table[row, 2:], atol=1e-6)
    np.testing.assert_allclose(frame.ghosts[0].state[qpos], table[row, 2:])
    session.obey(command(reset, random=False))
    assert session.stage.frame().status.clip == (2, 2, 0)  # new episodes begin anywhere in the clip
    session.obey(command(show_clip, -1, clip=3, frame=10_000))
    assert session.stage.frame().status.clip == (-1, 3, 199) and not session.stage.frame().messages


def test_faults_and_ends_of_episodes_are_shown_as_messages(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)

    def bad(obs: torch.Tensor) -> torch.Tensor:
        action = torch.zeros(2, 3)
        action[1, 0] = math.nan
        return action

    session = Session(env, controllers={"fall": pushing, "bad": bad}, paused=True, seed=0)
    session.stage.frame()
    while not env.done[0].item():
        session.stage.advance()
    steps = session.stage.live.steps
    (message,) = session.stage.frame().messages
    assert message.startswith(f"the episode ended after {steps} steps (terminated), return ")
    session.obey(command(set_mode, "controller", "bad"))
    session.stage.advance()
    assert "fault in world 1: action (1 so far)" in session.stage.frame().messages


def test_frames_contain_every_point_of_the_curves(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True, seed=0)
    assert session.stage.scene.curves == ("reward", "eval", *env.metrics)
    rewards = []
    for _ in range(20):
        session.stage.advance()
        rewards.append(env.reward[0].item())
    points = session.stage.frame().points
    assert points.shape == (20, 2 + len(session.stage.scene.curves))
    np.testing.assert_array_equal(points[:, 2], rewards)
    np.testing.assert_allclose(points[:, 0], env.timestep * np.arange(1, 21))
    session.obey(command(step_by, -5))
    session.obey(command(step_by, 6))
    np.testing.assert_allclose(session.stage.frame().points[:, 0], [env.timestep * 21])


def test_frame_contains_model_fields_that_differ_between_worlds() -> None:
    env = lw.make("hopper", nworld=2, dynamics=["body_mass"])
    session = Session(env, paused=True)
    masses = env.model.body_mass.copy()
    masses[2] *= 2
    env.set_dynamics(body_mass=masses)
    np.testing.assert_array_equal(session.stage.frame().model_fields["body_mass"], masses.astype(np.float32))
