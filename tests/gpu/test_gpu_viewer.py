import numpy as np
import pytest
import torch
from test_gpu import nothing_waits

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, set_ghosts, set_mode, set_world
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session

pytestmark = pytest.mark.gpu


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
