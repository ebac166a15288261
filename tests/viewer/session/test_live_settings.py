import torch

import lyceum_warp as lw
from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.session.clock import Session


def test_planner_continues_with_changed_settings() -> None:
    env = lw.make("reach", autoreset=False, nthread=1)
    session = Session(env, controllers={"mppi": lw.MPPI("reach", samples=8)}, seed=0, paused=True)
    stage = session.stage
    stage.advance()
    assert dict(stage.frame().status.planner) == {"noise": 1.0, "temperature": 0.2, "horizon": 16, "samples": 8}
    for name, value in (("noise", 0.5), ("samples", 12), ("horizon", 10)):
        session.obey(protocol.SetNumber("planner", name, value))
    config = stage.controllers["mppi"].controller.config  # type: ignore[union-attr]
    assert (config.noise, config.samples, config.horizon, config.temperature) == (0.5, 12, 10, 0.2)
    stage.advance()
    session.obey(protocol.SetNumber("planner", "temperature", -1.0))
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
    session.obey(protocol.SetNumber("task", name, value + 1.0))
    assert dict(session.stage.frame().status.params)[name] == value + 1.0
    env.set_state(state)
    env.step(torch.ones(2, 3))
    torch.testing.assert_close(env.reward, before - 3.0)
