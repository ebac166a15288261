"""The past of worlds, their returns, and their rows for frames."""

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from memory_window import pushing
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import Perturb, StepBy
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.live import HISTORY_BYTES, PLANT_HISTORY_BYTES, Live

PLANNER = dict(horizon=8, samples=6, temperature=0.01, noise=0.3)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_going_on_after_stepping_back_gives_the_same_numbers_to_the_bit(shared_env: SharedEnv, engine: str) -> None:
    env = shared_env("hopper", engine=engine, nworld=3)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=1)
    states = [env.get_state()]
    for _ in range(40):  # some episodes end on the way
        session.stage.advance()
        states.append(env.get_state())
    session.obey(StepBy(-15))
    assert torch.equal(env.get_state(), states[25]) and session.stage.live.past.ahead == 15
    for k in range(26, 41):
        session.obey(StepBy(1))
        assert torch.equal(env.get_state(), states[k])
    assert session.stage.live.past.ahead == 0
    session.obey(StepBy(-40))
    assert torch.equal(env.get_state(), states[0])
    session.obey(StepBy(40))
    assert torch.equal(env.get_state(), states[40])
    session.stage.advance()  # a new step, which the policy chooses
    assert session.stage.live.past.behind == 41


def test_steps_that_were_taken_back_are_repeated_with_resets_and_pushes(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, paused=True, seed=2)
    session.stage.advance(3)
    session.obey(protocol.Reset(random=True))
    after_reset = env.get_state()
    session.stage.advance(2)
    force = np.zeros((env.model.nbody, 6))
    force[1, 0] = 50.0
    session.obey(Perturb(force))
    session.stage.advance(2)
    session.obey(Perturb(0 * force))
    session.stage.advance(2)
    last, returns = env.get_state(), session.stage.live.returns.clone()
    session.obey(StepBy(-6))
    assert torch.equal(env.get_state(), after_reset)
    session.obey(StepBy(-1))
    session.obey(StepBy(7))
    assert torch.equal(env.get_state(), last) and torch.equal(session.stage.live.returns, returns)


def test_a_planners_steps_are_repeated_with_its_actions(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", autoreset=False)
    session = Session(env, controllers={"mppi": lw.MPPI("point_mass", **PLANNER)}, paused=True, seed=0)
    states = [env.get_state()]
    for _ in range(6):
        session.stage.advance()
        states.append(env.get_state())
    session.obey(StepBy(-4))
    assert torch.equal(env.get_state(), states[2])
    session.obey(StepBy(4))
    assert torch.equal(env.get_state(), states[6])


def test_the_past_is_bounded_and_a_message_says_where_it_ends(shared_env: SharedEnv) -> None:
    env = shared_env("hopper")
    session = Session(env, paused=True)
    past = session.stage.live.past
    assert past.bytes <= 256 * 2**20 and past.length <= 2000
    session.stage.advance(past.length + 20)
    assert past.behind == past.length - 1
    session.obey(StepBy(-past.length - 5))
    assert past.behind == 0 and past.ahead == past.length - 1
    assert "the past ends here" in session.stage.frame().messages[0]
    session.obey(protocol.Reset(random=False))
    assert past.ahead == 0


def test_a_past_that_does_not_fit_is_not_kept(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    live = Live(env, limit=1000)
    assert live.past.bytes == live.past.length == 0
    before = env.get_state()
    for _ in range(3):
        live.step(lambda: None)
    after = env.get_state()
    assert live.back(2) == 0 and torch.equal(env.get_state(), after) and not torch.equal(after, before)
    live.request(burst=4)
    rows = live.take()
    assert rows is not None and rows.back_steps == () and len(rows.points) == 3


def test_all_pasts_of_a_session_are_bounded_together(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=3)
    session = Session(env, controllers={"own": towards})
    assert session.stage.live.env is not env
    assert PLANT_HISTORY_BYTES + HISTORY_BYTES == 256 * 2**20
    assert session.stage.live.past.bytes <= PLANT_HISTORY_BYTES


def test_the_return_ends_with_the_episode(shared_env: SharedEnv) -> None:
    """Also without automatic resets, where the worlds go on."""
    env = lw.make("hopper", nworld=3, autoreset=False)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=0)
    total, over = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.bool)
    for _ in range(60):
        session.stage.advance()
        total += env.reward.double().masked_fill(over, 0.0)
        over |= env.done
    assert over.all() and (env.reward != 0).any()
    assert torch.equal(session.stage.live.returns, total)
    session.obey(protocol.SetWorld("worst"))
    assert session.stage.frame().status.world == int(total.argmin())
    assert ("return", f"{total.min().item():.6g}") in session.stage.frame().status.text
