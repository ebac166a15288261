import numpy as np
import pytest
import torch
from test_gpu import nothing_waits

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, set_ghosts, set_mode, set_paused, set_world, step_by
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session

pytestmark = pytest.mark.gpu


def pushing(obs: torch.Tensor) -> torch.Tensor:
    return 0.5 * torch.sign(obs[:, :3])


def test_steps_do_not_wait_for_the_device() -> None:
    env = lw.make("hopper", nworld=1024, device="cuda")
    session = Session(env, controllers={"policy": lw.GaussianPolicy(11, 3)}, seed=0)
    session.obey(command(set_world, 3))
    session.obey(command(set_ghosts, Ghosts(worlds=2, burst=4)))
    for _ in range(3):
        session.stage.advance(2)
        session.stage.frame()
    with nothing_waits():
        session.stage.advance(20)


def test_viewer_shows_the_chosen_world() -> None:
    env = lw.make("hopper", nworld=4096, device="cuda")
    session = Session(env, controllers={"policy": pushing}, seed=0)
    session.obey(command(set_world, 3000))
    assert session.stage.live.past.states.nbytes <= 256 * 2**20
    session.stage.advance(5)
    shown = env.get_state()[3000].cpu().numpy()
    frame = session.stage.frame()
    np.testing.assert_array_equal(frame.state, shown[: len(frame.state)])
    session.obey(command(set_paused, True))
    session.obey(command(set_ghosts, Ghosts(worlds=1, burst=3)))
    session.obey(command(set_world, "best"))
    frame = session.stage.frame()
    assert frame.status.world == int(session.stage.live.returns.argmax())
    state, qpos = env.get_state(), env.state_space.parts["qpos"]
    np.testing.assert_array_equal(frame.state, state[frame.status.world, : len(frame.state)].cpu().numpy())
    other = state[(frame.status.world + 1) % 4096, qpos].cpu().numpy()
    np.testing.assert_array_equal(frame.ghosts[0].state[qpos], other)
    assert len(frame.ghosts) == 4
    session.stage.advance(60)
    frame = session.stage.frame()
    assert np.isfinite(frame.points).all() and all("fault" not in message for message in frame.messages)


def test_steps_after_stepping_back_give_identical_states() -> None:
    env = lw.make("hopper", nworld=64, device="cuda", deterministic=True)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=1)
    states = [env.get_state()]
    for _ in range(30):
        session.stage.advance()
        states.append(env.get_state())
    session.obey(command(step_by, -20))
    assert torch.equal(env.get_state(), states[10])
    for k in range(11, 31):
        session.obey(command(step_by, 1))
        assert torch.equal(env.get_state(), states[k])


def test_a_planner_controls_a_copy_of_a_world_on_a_gpu() -> None:
    env = lw.make("reach", nworld=256, device="cuda")
    session = Session(env, controllers={"policy": lw.GaussianPolicy(env.obs_space.size, 7), "mppi": lw.MPPI("reach")},
                      paused=True, seed=0)  # fmt: skip
    session.obey(command(set_world, 100))
    session.stage.advance(3)
    before = env.get_state()
    session.obey(command(set_mode, "controller", "mppi"))
    assert session.stage.live.env.obs.device.type == "cpu"
    qpos = env.state_space.parts["qpos"]
    np.testing.assert_allclose(session.stage.frame().state[qpos], before[100, qpos].cpu().numpy(), atol=1e-6)
    session.stage.advance(3)
    session.obey(command(set_mode, "controller", "policy"))
    after = env.get_state()
    assert torch.equal(after[99], before[99]) and not torch.equal(after[100, qpos], before[100, qpos])
