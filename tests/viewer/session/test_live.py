import torch
from conftest import SharedEnv
from memory_window import pushing
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, reset, set_mode, set_world, step_by
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.live import HISTORY_BYTES, PLANT_HISTORY_BYTES


def test_steps_back_and_forth_restore_the_states_bit_for_bit(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=3)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=1)
    states = [env.get_state()]
    for k in range(40):
        if k == 20:
            session.obey(command(reset, random=True))
            states[-1] = env.get_state()
        session.stage.advance()
        states.append(env.get_state())
    returns = session.stage.live.returns.clone()
    for steps, expected in ((-15, 25), (1, 26), (1, 27), (13, 40), (-40, 0), (100, 40)):
        past = session.stage.live.past
        session.obey(command(step_by, min(steps, past.ahead) if steps > 0 else steps))
        assert torch.equal(env.get_state(), states[expected]) and past.ahead == 40 - expected
    assert torch.equal(session.stage.live.returns, returns)
    session.stage.advance()  # a new step
    assert session.stage.live.past.behind == 41
    session.obey(command(step_by, -5))
    restored = env.get_state()
    session.obey(command(set_mode, "passive"))
    session.obey(command(step_by, 1))
    assert session.stage.live.past.ahead == 0 and not torch.equal(env.get_state(), restored)


def test_the_history_is_bounded_and_its_end_is_reported(shared_env: SharedEnv) -> None:
    env = shared_env("hopper")
    session = Session(env, paused=True)
    past = session.stage.live.past
    assert past.states.nbytes + past.returns.nbytes <= HISTORY_BYTES and past.length <= 2000
    session.stage.advance(past.length + 20)
    assert past.behind == past.length - 1
    session.obey(command(step_by, -past.length - 5))
    assert past.behind == 0 and past.ahead == past.length - 1
    assert "the history ends here" in session.stage.frame().messages[0]
    session.obey(command(reset, random=False))
    assert past.ahead == 0
    assert Session(lw.make("hopper", horizon=3000)).stage.live.past.length == 3001  # a whole episode
    worlds = shared_env("point_mass", nworld=3)
    plant = Session(worlds, controllers={"own": towards}).stage.live
    assert plant.env is not worlds and plant.past.states.nbytes <= PLANT_HISTORY_BYTES


def test_return_of_a_world_without_autoreset_stays_constant_after_its_episode() -> None:
    env = lw.make("hopper", nworld=3, autoreset=False)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=0)
    total, over = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.bool)
    for _ in range(60):
        session.stage.advance()
        total += env.reward.double().masked_fill(over, 0.0)
        over |= env.done
    assert over.all() and (env.reward != 0).any()
    assert torch.equal(session.stage.live.returns, total)
    session.obey(command(set_world, "worst"))
    assert session.stage.frame().status.world == int(total.argmin())
    assert ("return", f"{total.min().item():.6g}") in session.stage.frame().status.text
