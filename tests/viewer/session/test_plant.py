import threading
import time

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from memory_window import run
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, reset, set_ghosts, set_mode, set_paused, set_speed, set_world, step_by
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session

PLANNER = dict(horizon=8, samples=6, temperature=0.01, noise=0.3)


def test_plant_runs_in_real_time_and_the_viewer_draws_the_plan() -> None:
    env = lw.make("point_mass", autoreset=False, horizon=0)
    session = Session(env, controllers={"mppi": lw.MPPI("point_mass", **PLANNER)}, seed=0)
    begun = time.monotonic()
    window = run(
        session,
        lambda frame: frame.traces is not None and frame.status.time > 0.4,
        [command(set_paused, True), command(step_by, -5)],
        lambda frame: frame.status.paused and frame.status.seekable[1] - frame.status.step == 5,
        [command(step_by, 5), command(set_paused, False), command(set_speed, 4.0)],
        lambda frame: frame.status.time > 1.5,
    )
    frame = window.frames[-1]
    assert frame.status.time < 4 * (time.monotonic() - begun)
    assert frame.traces.shape == (7, 9, 3) and len(frame.ghosts) == 1
    assert frame.status.plan_ms > 0 and session.stage.paused is False
    np.testing.assert_allclose(np.ptp(frame.traces[:, 0], axis=0), 0.0, atol=1e-12)
    assert np.isfinite(np.concatenate([frame.points for frame in window.frames])).all()


def test_planner_controls_a_copy_of_the_world_in_view(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=3)
    mppi = lw.MPPI("point_mass", **PLANNER)
    session = Session(env, controllers={"mppi": mppi, "own": towards}, paused=True, seed=0)
    session.obey(command(set_world, 1))
    before, qpos = env.get_state(), env.state_space.parts["qpos"]
    session.stage.advance(3)
    assert torch.equal(env.get_state(), before)
    moved = session.stage.live.env.get_state()[0]
    assert not torch.equal(moved, before[1])
    session.obey(command(set_ghosts, Ghosts(worlds=1)))
    np.testing.assert_array_equal(session.stage.frame().ghosts[0].state[qpos], before[2, qpos].numpy())
    session.obey(command(set_world, 2))
    assert torch.equal(env.get_state()[1, qpos], moved[qpos])
    assert torch.equal(session.stage.live.env.get_state()[0, qpos], before[2, qpos])
    session.obey(command(set_mode, "controller", "own"))
    session.stage.advance()
    session.obey(command(set_mode, "passive"))
    after = env.get_state()
    assert torch.equal(after[0], before[0]) and not torch.equal(after[2, qpos], before[2, qpos])
    assert session.stage.frame().status.world == 2


def test_plant_starts_another_episode_after_the_end_of_an_episode() -> None:
    env = lw.make("point_mass", autoreset=False, horizon=12)
    session = Session(env, controllers={"own": towards}, seed=0)
    session.obey(command(set_speed, 8.0))
    window = run(session, lambda frame: session.stage.live.steps > 30)
    ends = [message for message in window.messages if "the episode ended after 12 steps (truncated)" in message]
    assert len(ends) >= 2


class Slow:
    """A controller that logs its calls. It blocks in the seventh call and all later ones."""

    def __init__(self) -> None:
        self.inside, self.log, self.release = 0, [], threading.Event()

    def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        self.inside += 1
        self.log.append("call")
        if len(self.log) > 6:
            assert self.release.wait(60)
        self.inside -= 1
        return torch.zeros(2)

    def reset(self, seed: int | None = None) -> None:
        self.log.append("reset" if not self.inside else "reset within a call")


def test_a_slow_plan_does_not_delay_commands(shared_env: SharedEnv) -> None:
    env, slow = shared_env("point_mass", nworld=3), Slow()
    session = Session(env, controllers={"slow": slow}, seed=0)
    run(
        session,
        lambda frame: len(slow.log) > 6 and slow.inside == 1,
        [command(reset, random=True)],
        lambda frame: frame.status.step == 0,
        [command(set_world, 1)],
        lambda frame: frame.status.world == 1,
        [command(set_paused, True)],
        lambda frame: frame.status.paused,
        [command(set_paused, False), command(set_speed, 2.0)],
        lambda frame: frame.status.speed == 2.0,
    )
    calls = len(slow.log)
    assert slow.inside == 1
    slow.release.set()
    while slow.inside:
        time.sleep(0.01)
    time.sleep(0.1)
    assert len(slow.log) == calls  # no calls after the end of the session
    assert "reset within a call" not in slow.log


@pytest.mark.parametrize(
    ("kind", "text"),
    [("policy", "KeyError: 'no such\\nkey'"), ("planner", "ZeroDivisionError: no time"),
     ("unfit", "ValueError: a controller must return an action of shape (2,)")],
)  # fmt: skip
@pytest.mark.parametrize("paused", [False, True])
def test_failing_controller_is_reported_and_stopped(
    shared_env: SharedEnv, capsys: pytest.CaptureFixture[str], kind: str, text: str, paused: bool
) -> None:
    calls = []

    def policy(obs: torch.Tensor) -> torch.Tensor:
        calls.append(0)
        return torch.zeros(2, 2) if len(calls) <= 3 else {}["no such\nkey"]

    def planner(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError("no time")

    def unfit(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(7)

    controller = {"policy": policy, "planner": planner, "unfit": unfit}[kind]
    session = Session(shared_env("point_mass", nworld=2), controllers={kind: controller}, seed=0, paused=paused)
    script = [[command(step_by, 20)]] if paused else []
    window = run(session, *script, lambda frame: frame.status.mode == "passive" and bool(frame.messages))
    assert window.messages[0].startswith(f"the controller {kind!r} failed: {text}")
    assert session.stage.paused and window.frames[-1].status.paused
    assert "Traceback" in capsys.readouterr().err
