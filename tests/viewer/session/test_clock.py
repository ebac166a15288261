"""A session with real worlds and controllers, and a window in memory."""

import atexit
import math
import socket
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from memory_window import MemoryWindow
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer.protocol import (
    MOST_BURST,
    MOST_GHOSTS,
    Close,
    Command,
    Frame,
    Perturb,
    Reset,
    Seek,
    SetBackwards,
    SetController,
    SetEpisode,
    SetGhosts,
    SetMode,
    SetPaused,
    SetSpeed,
    SetVideo,
    SetWorld,
    StepBy,
)
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.live import HISTORY_BYTES, PLANT_HISTORY_BYTES, Live
from lyceum_warp.viewer.show import chosen_graphics
from lyceum_warp.viz.video import Recorder

PLANNER = dict(horizon=8, samples=6, temperature=0.01, noise=0.3)


def run(session: Session, *script: Iterable[Command] | Callable[[Frame], Iterable[Command] | None]) -> MemoryWindow:
    """Run a session: after each frame the next entry of the script. A function is called until it returns None."""
    entries = list(script)

    def after(frame: Frame, number: int) -> Iterable[Command] | None:
        while entries:
            entry = entries[0]
            if not callable(entry):
                entries.pop(0)
                return entry
            if (commands := entry(frame)) is not None:
                return commands
            entries.pop(0)
        return None

    window = MemoryWindow(after)
    session.run(window)
    assert window.closed == 1
    return window


def until(wanted: Callable[[Frame], bool]) -> Callable[[Frame], list[Command] | None]:
    return lambda frame: None if wanted(frame) else []


def pushing(obs: torch.Tensor) -> torch.Tensor:
    return 0.5 * torch.sign(obs[:, :3])


# stepping forwards and back


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
    session.obey(Reset(random=True))
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
    session.obey(Reset(random=False))
    assert past.ahead == 0


def test_seeking_shows_a_step_of_the_episode(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, seed=0)
    session.stage.advance(8)
    session.obey(Seek(3))
    frame = session.stage.frame()
    assert frame.status.step == 3 and frame.status.paused and frame.status.seekable == (0, 8)
    session.obey(Seek(100))
    assert session.stage.frame().status.step == 8


def test_another_controller_acts_after_steps_back(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, controllers={"a": pushing, "b": lambda obs: 0.5 * pushing(obs)}, paused=True, seed=1)
    session.stage.advance(6)
    session.obey(StepBy(-4))
    session.obey(SetController("b"))
    assert session.stage.live.past.ahead == 0 and session.stage.live.past.behind == 2
    session.obey(StepBy(1))
    assert env.action.abs().max() == 0.25
    session.obey(StepBy(-1))
    session.obey(SetMode("passive"))
    session.obey(StepBy(1))
    assert env.action.abs().max() == 0


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
    session.obey(SetWorld("worst"))
    assert session.stage.frame().status.world == int(total.argmin())
    assert ("return", f"{total.min().item():.6g}") in session.stage.frame().status.text


# pushes


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
    session.obey(SetWorld(1))
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

    branches = (Perturb(0 * push.forces, qpos=qpos), SetMode("passive"), SetController("other"), SetWorld(1))
    for branch in branches:  # each of them drops the steps ahead
        past_push()
        session.obey(branch)
        assert not pushed(env, 0), branch
        session.obey(Reset(random=False))
        session.obey(SetWorld(0))
        session.obey(SetController("policy"))
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
    session.obey(SetMode("passive"))
    session.obey(push)
    session.obey(SetController("look"))
    assert pushed(session.stage.live.env, 0) and not pushed(env, 0)
    session.stage.advance(2)
    assert seen == [0.0, 0.0]
    session.obey(released(push))
    assert not pushed(session.stage.live.env, 0)


# worlds


def test_worlds_are_chosen_by_number_and_by_return(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=4)
    session = Session(env, controllers={"policy": pushing}, paused=True, seed=0)
    session.obey(SetWorld("last_ended"))
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
        session.obey(SetWorld(choice))
        frame = session.stage.frame()
        assert frame.status.world == int(expected), choice
        np.testing.assert_array_equal(frame.state, env.get_state()[int(expected), : len(frame.state)].numpy())
    session.obey(SetWorld("last_ended"))
    assert session.stage.frame().status.world in ended
    session.obey(SetWorld(4))
    assert session.stage.frame().messages == ("there is no world 4: there are 4 worlds, 0 to 3",)


def test_rows_that_come_later_are_shown_a_frame_later(shared_env: SharedEnv) -> None:
    """As those of worlds on a GPU."""
    env = shared_env("hopper", nworld=4)
    session = Session(env, controllers={"policy": pushing}, seed=0)
    session.stage.live.asynchronous = True
    points, rewards = [session.stage.frame().samples], []
    for _ in range(6):
        at_last_frame = env.get_state()[0]
        for _ in range(5):
            session.stage.advance()
            rewards.append(env.reward[0].item())
        frame = session.stage.frame()
        np.testing.assert_array_equal(frame.state, at_last_frame[: len(frame.state)].numpy())
        points.append(frame.samples)
    session.obey(SetPaused(True))
    frame = session.stage.frame()  # while paused, of now
    np.testing.assert_array_equal(frame.state, env.get_state()[0, : len(frame.state)].numpy())
    np.testing.assert_array_equal(np.concatenate([*points, frame.samples])[:, 1], rewards)


def test_other_worlds_and_the_past_are_shown_as_ghosts(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=4)
    session = Session(env, paused=True, seed=0)
    session.stage.advance(10)
    session.obey(SetGhosts(worlds=(1, 3), burst=5, fade=0.5, doppler=True))
    ghosts = session.stage.frame().ghosts
    state, qpos = env.get_state(), env.state_space.parts["qpos"]
    for ghost, world in zip(ghosts, (1, 3), strict=False):
        np.testing.assert_array_equal(ghost.pose.qpos, state[world, qpos].numpy())
    past = ghosts[2:]
    assert len(past) == 5 and past[0].colour[3] == 2 * past[1].colour[3]
    np.testing.assert_array_equal(past[-1].pose.qpos, session.stage.live.past.states[0, 0, qpos].numpy())
    session.obey(SetGhosts(worlds=(9,)))
    assert "there is no world 9" in session.stage.frame().messages[0]
    for ghosts, text in (
        (SetGhosts(worlds=(0,) * (MOST_GHOSTS + 1)), "at most 32 worlds are drawn as ghosts, not 33"),
        (SetGhosts(burst=MOST_BURST + 1), "at most 50 states of the burst"),
    ):
        session.obey(ghosts)
        assert text in session.stage.frame().messages[0]
    assert len(session.stage.frame().ghosts) == 7


def test_ends_of_episodes_and_faults_become_messages(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)

    def bad(obs: torch.Tensor) -> torch.Tensor:
        action = torch.zeros(2, 3)
        action[1, 0] = math.nan
        return action

    session = Session(env, controllers={"fall": pushing, "bad": bad}, paused=True, seed=0)
    session.stage.frame()
    while not env.done[0].item():
        session.stage.advance()
    steps = session.stage.live.made
    (message,) = session.stage.frame().messages
    assert message.startswith(f"the episode ended after {steps} steps (terminated), return ")
    session.obey(SetController("bad"))
    session.stage.advance()
    assert "fault in world 1: action (1 so far)" in session.stage.frame().messages


def test_frames_hold_every_point_of_the_curves() -> None:
    env = lw.make("hopper", nworld=2)
    session = Session(env, paused=True, seed=0)
    assert session.stage.scene.curves == ("reward", "eval", *env.metrics)
    rewards = []
    for _ in range(20):
        session.stage.advance()
        rewards.append(env.reward[0].item())
    points = session.stage.frame().samples
    assert points.shape == (20, 1 + len(session.stage.scene.curves))
    np.testing.assert_array_equal(points[:, 1], rewards)
    np.testing.assert_allclose(points[:, 0], env.timestep * np.arange(1, 21))


def test_model_fields_that_differ_are_in_the_frame() -> None:
    env = lw.make("hopper", nworld=2, dynamics=["body_mass"])
    session = Session(env, paused=True)
    assert session.stage.frame().model_fields == {}
    masses = env.model.body_mass.copy()
    masses[2] *= 2
    env.set_dynamics(body_mass=masses)
    np.testing.assert_array_equal(session.stage.frame().model_fields["body_mass"], masses.astype(np.float32))


# modes and controllers


def test_controllers_are_switched_and_passive_worlds_have_no_controls(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2)
    session = Session(env, controllers={"push": pushing, "half": lambda obs: 0.5 * pushing(obs)}, paused=True)
    assert session.stage.scene.modes == ("controller", "passive") and session.stage.frame().status.controller == "push"
    session.stage.advance()
    assert env.action.abs().max() == 0.5
    session.obey(SetController("half"))
    session.stage.advance()
    assert env.action.abs().max() == 0.25 and session.stage.frame().status.controller == "half"
    session.obey(SetMode("passive"))
    session.stage.advance()
    assert env.action.abs().max() == 0 and session.stage.frame().status.controller is None
    session.obey(SetController("none"))
    assert session.stage.frame().messages == ("there is no controller 'none': there are push, half",)
    session.obey(SetMode("playback"))
    assert "there is no mode 'playback' here" in session.stage.frame().messages[0]


def test_a_planner_keeps_its_rate_and_shows_its_plan() -> None:
    env = lw.make("point_mass", autoreset=False, horizon=0)
    session = Session(env, controllers={"mppi": lw.MPPI("point_mass", **PLANNER)}, seed=0)
    begun = time.monotonic()
    window = run(
        session,
        until(lambda frame: frame.traces is not None and frame.status.time > 0.4),
        [SetPaused(True)],
        [StepBy(-5)],
        until(lambda frame: frame.status.paused and frame.status.seekable[1] - frame.status.step == 5),
        [StepBy(5), SetPaused(False), SetSpeed(4.0)],
        until(lambda frame: frame.status.time > 1.5),
    )
    frame = window.frames[-1]
    assert frame.status.time < 4 * (time.monotonic() - begun)
    assert frame.traces.shape == (7, 9, 3) and frame.best == 0 and len(frame.ghosts) == 1
    assert frame.status.plan_ms > 0 and session.stage.paused is False
    # the points of the paths begin where the point is
    np.testing.assert_allclose(np.ptp(frame.traces[:, 0], axis=0), 0.0, atol=1e-12)
    points = np.concatenate([frame.samples for frame in window.frames])
    assert np.isfinite(points).all()


def test_a_planner_controls_a_copy_of_the_shown_world(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=3)
    mppi = lw.MPPI("point_mass", **PLANNER)
    session = Session(env, controllers={"mppi": mppi, "own": towards}, world=1, paused=True, seed=0)
    before = env.get_state()
    session.stage.advance(3)
    assert torch.equal(env.get_state(), before)
    moved = session.stage.live.env.get_state()[0]
    assert not torch.equal(moved, before[1])
    session.obey(SetGhosts(worlds=(0,)))
    np.testing.assert_array_equal(
        session.stage.frame().ghosts[0].pose.qpos, before[0, env.state_space.parts["qpos"]].numpy()
    )
    session.obey(SetWorld(2))  # world 1 goes on where the copy stopped
    qpos = env.state_space.parts["qpos"]
    assert torch.equal(env.get_state()[1, qpos], moved[qpos])
    assert torch.equal(session.stage.live.env.get_state()[0, qpos], before[2, qpos])
    session.obey(SetController("own"))
    session.stage.advance()
    session.obey(SetMode("passive"))
    after = env.get_state()
    assert torch.equal(after[0], before[0]) and not torch.equal(after[2, qpos], before[2, qpos])
    assert session.stage.frame().status.world == 2


def test_an_episode_of_a_plant_that_ends_is_followed_by_another() -> None:
    env = lw.make("point_mass", autoreset=False, horizon=12)
    done: list[lw.Trajectory] = []
    session = Session(env, controllers={"own": towards}, seed=0, on_trajectory=done.append)
    session.obey(SetSpeed(8.0))
    window = run(session, until(lambda frame: session.stage.live.made > 30))
    assert [episode.steps for episode in done[:2]] == [12, 12] and done[0].truncated
    assert any("the episode ended after 12 steps (truncated)" in message for message in window.messages)


def test_a_planner_does_not_foresee_a_push() -> None:
    env = lw.make("point_mass", autoreset=False)
    seen = []

    def look(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        seen.append(state[env.state_space.parts["xfrc_applied"]].abs().max().item())
        return torch.zeros(2)

    session = Session(env, controllers={"look": look}, paused=True, seed=0)
    force = np.zeros((env.model.nbody, 6))
    force[1, 0] = 1.0
    before = env.get_state()
    session.obey(Perturb(force))
    session.stage.advance(5)
    assert seen == [0.0] * 5
    qpos = env.state_space.parts["qpos"]
    assert env.get_state()[0, qpos][0] > before[0, qpos][0]
    session.obey(Perturb(0 * force))
    assert env.get_state()[0, env.state_space.parts["xfrc_applied"]].abs().max() == 0


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


class Slow:
    """A controller whose calls take a while, and that notes its calls and resets in order."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.inside, self.log = seconds, 0, []

    def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        self.inside += 1
        self.log.append("call")
        time.sleep(self.seconds if len(self.log) > 6 else 0.0)
        self.inside -= 1
        return torch.zeros(2)

    def reset(self, seed: int | None = None) -> None:
        self.log.append("reset" if not self.inside else "reset within a call")


def test_a_slow_plan_does_not_hold_up_commands(shared_env: SharedEnv) -> None:
    env, slow, seconds = shared_env("point_mass", nworld=3), Slow(2.0), []
    session = Session(env, controllers={"slow": slow}, seed=0)
    exits = atexit._ncallbacks()

    def shown(done: Callable[[Frame], bool]) -> Callable[[Frame], list[Command] | None]:
        begun: list[float] = []

        def entry(frame: Frame) -> list[Command] | None:
            begun.append(time.monotonic())
            if not done(frame):
                return []
            seconds.append(begun[-1] - begun[0])
            return None

        return entry

    run(
        session,
        until(lambda frame: len(slow.log) > 6 and slow.inside == 1),
        [Reset(random=True)],
        shown(lambda frame: frame.status.step == 0),
        [SetWorld(1)],
        shown(lambda frame: frame.status.world == 1),
        [SetPaused(True)],
        shown(lambda frame: frame.status.paused),
        [SetPaused(False), SetSpeed(2.0)],
        shown(lambda frame: frame.status.speed == 2.0),
    )
    assert max(seconds) < 1.5
    assert "reset within a call" not in slow.log
    assert atexit._ncallbacks() <= exits + 1
    while slow.inside:
        time.sleep(0.01)
    calls = len(slow.log)
    time.sleep(0.1)
    assert len(slow.log) == calls  # calls of runs that are over


def test_a_controller_that_fails_is_shown_and_loses_control(
    shared_env: SharedEnv, capsys: pytest.CaptureFixture[str]
) -> None:
    env = shared_env("point_mass", nworld=2)
    calls = []

    def policy(obs: torch.Tensor) -> torch.Tensor:
        calls.append(0)
        if len(calls) > 3:
            raise KeyError("no such\nkey")
        return torch.zeros(2, 2)

    def planner(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        calls.append(0)
        if len(calls) > 8:
            raise ZeroDivisionError("no time")
        return torch.zeros(2)

    def unfit(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(7)

    for name, controller, text in (
        ("policy", policy, "KeyError: 'no such\\nkey'"), ("planner", planner, "ZeroDivisionError: no time"),
        ("unfit", unfit, "ValueError: a controller must return an action of shape (2,)"),
    ):  # fmt: skip
        calls.clear()
        session = Session(env, controllers={name: controller}, seed=0)
        window = run(session, until(lambda frame: frame.status.mode == "passive" and bool(frame.messages)))
        assert window.messages[0].startswith(f"the controller {name!r} failed: {text}")
        assert session.stage.paused and window.frames[-1].status.paused
        assert "Traceback" in capsys.readouterr().err
    calls.clear()
    session = Session(env, controllers={"planner": planner}, paused=True)
    session.obey(StepBy(20))
    assert session.stage.mode == "passive" and "ZeroDivisionError" in session.stage.frame().messages[0]


# playback


@pytest.fixture(scope="module")
def trajectories() -> list[lw.Trajectory]:
    env = lw.make("point_mass", autoreset=False, horizon=20)
    return [lw.control(env, towards, seed=seed, steps=20 - 5 * seed) for seed in (0, 1)]


def test_a_playback_is_sought_reversed_and_looped(shared_env: SharedEnv, trajectories: list[lw.Trajectory]) -> None:
    env = shared_env("point_mass")
    session = Session(env, episodes=trajectories, paused=True)
    assert session.stage.scene.modes == ("playback", "passive") and session.stage.scene.episodes == (
        "episode 0",
        "episode 1",
    )
    qpos = env.state_space.parts["qpos"]

    def shown() -> np.ndarray:
        return session.stage.frame().pose.qpos

    session.obey(Seek(7))
    np.testing.assert_array_equal(shown(), trajectories[0].states[7, qpos])
    session.obey(StepBy(-2))
    assert session.stage.frame().status.step == 5
    session.obey(SetBackwards(True))
    session.stage.advance(6)
    assert session.stage.frame().status.step == 20  # after the first step the last one
    session.obey(SetEpisode(1))
    frame = session.stage.frame()
    assert frame.status.step == 15 and frame.status.steps == 15 and frame.status.episode == 1
    session.obey(SetBackwards(False))
    session.obey(Reset(random=False))
    session.stage.frame()
    session.stage.advance(3)
    points = session.stage.frame().samples
    np.testing.assert_allclose(points[:, 1], trajectories[1].rewards[:3])
    session.obey(SetGhosts(episodes=(0, 1), burst=4, doppler=True))
    ghosts = session.stage.frame().ghosts
    np.testing.assert_array_equal(ghosts[0].pose.qpos, trajectories[0].states[3, qpos])
    past = [ghost for ghost in ghosts[1:] if ghost.colour[0] > ghost.colour[2]]
    assert len(past) == 1 and len(ghosts) == 5
    session.obey(SetEpisode(5))
    assert session.stage.frame().messages == ("there is no episode 5: there are 2, from 0",)


def test_worlds_go_on_from_the_state_of_a_playback(shared_env: SharedEnv, trajectories: list[lw.Trajectory]) -> None:
    env = shared_env("point_mass")
    session = Session(env, episodes={"first": trajectories[0]}, paused=True)
    session.obey(Seek(20))
    session.obey(SetMode("passive"))
    qpos = env.state_space.parts["qpos"]
    assert torch.equal(env.get_state()[0, qpos], trajectories[0].states[20, qpos])
    session.stage.advance()


def test_states_are_played_back_without_rewards(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass")
    states = torch.cat([env.get_state() for _ in range(4)])
    session = Session(env, episodes=states)
    session.stage.advance()
    frame = session.stage.frame()
    assert frame.status.steps == 3 and np.isnan(frame.samples[:, 1]).all()


def test_an_episode_that_does_not_fit_is_refused(shared_env: SharedEnv, trajectories: list[lw.Trajectory]) -> None:
    with pytest.raises(ValueError, match="episode 0 is an episode of the task 'point_mass', not of 'hopper'"):
        Session(shared_env("hopper"), episodes=trajectories)
    env = lw.make("point_mass", dynamics=["body_mass"])
    with pytest.raises(ValueError, match="episode 0 does not fit the task 'point_mass' as it is now"):
        Session(env, episodes=trajectories[0])
    with pytest.raises(ValueError, match="or states of shape"):
        Session(shared_env("hopper"), episodes=torch.zeros(3, 4))
    with pytest.raises(FileNotFoundError, match="missing.npz"):
        Session(shared_env("hopper"), episodes=["missing.npz"])


# the loop


def test_speed_and_pause_hold(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass")
    session = Session(env)
    window = run(
        session,
        [SetSpeed(8.0)],
        until(lambda frame: frame.status.measured_speed > 4),
        [SetPaused(True)],
        until(lambda frame: frame.status.paused),
        [SetSpeed(100.0)],
        until(lambda frame: frame.status.speed == 16.0),
        [Close()],
        lambda frame: [],
    )
    paused = [frame for frame in window.frames if frame.status.paused]
    assert len({frame.status.step for frame in paused}) == 1


@pytest.mark.parametrize("speed", [4.0, 16.0])
def test_frames_come_as_often_where_a_plant_never_waits(speed: float) -> None:
    env = lw.make("point_mass", autoreset=False, horizon=0)
    session = Session(env, controllers={"none": lambda state, obs: torch.zeros(2)}, seed=0, fps=20.0)
    session.obey(SetSpeed(speed))
    frames: list[float] = []

    def timed(frame: Frame) -> list[Command] | None:
        frames.append(time.monotonic())
        return [] if frames[-1] - frames[0] < 2.0 else None

    run(session, until(lambda frame: session.stage.live.made > 0), timed)
    assert len(frames) > 20


def test_an_exception_does_not_wait_for_videos(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C as well: drawing what is left may take minutes."""
    monkeypatch.chdir(tmp_path)
    session = Session(shared_env("point_mass"), seed=0)

    def interrupted(frame: Frame) -> list[Command]:
        if frame.status.video is None:
            return [SetVideo(True)]
        raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run(session, interrupted)
    assert time.monotonic() - begun < 20


def test_a_video_that_cannot_be_written_is_a_message(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(tmp_path)
    session = Session(shared_env("point_mass"), seed=0)
    monkeypatch.setattr(Recorder, "__init__", full)
    session.obey(SetVideo(True))
    assert "No space left on device" in session.stage.frame().messages[0]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Recorder, "add", full)
    window = run(session, [SetVideo(True)], until(lambda frame: bool(frame.messages)))
    assert "No space left on device" in window.messages[0] and window.frames[-1].status.video is None


def test_a_refused_port_leaves_no_thread(shared_env: SharedEnv) -> None:
    env, mppi = shared_env("point_mass", nworld=3), lw.MPPI("point_mass", **PLANNER)
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        before = threading.enumerate()
        with pytest.raises(ValueError, match="port"):
            lw.view(env, controllers={"mppi": mppi}, port=busy.getsockname()[1], gfx="web")
    assert [thread.name for thread in threading.enumerate() if thread not in before] == []


def test_a_window_that_is_closed_or_fails_ends_the_session(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", autoreset=False)
    session = Session(env, controllers={"own": towards}, seed=0)
    assert run(session).frames

    class Broken(MemoryWindow):
        def show(self, frame: Frame) -> None:
            raise KeyboardInterrupt

    window = Broken(lambda frame, number: [])
    with pytest.raises(KeyboardInterrupt):
        Session(env, controllers={"own": towards}).run(window)
    assert window.closed == 1


@pytest.mark.parametrize("own", [False, True])
def test_a_session_that_waits_takes_little_time(shared_env: SharedEnv, own: bool) -> None:
    """Without a person who looks, the window wants few frames."""

    class Unwatched(MemoryWindow):
        wants_frame = False

        def is_open(self) -> bool:
            return time.monotonic() < self.end

        def commands(self) -> list[Command]:
            return []

    env = shared_env("point_mass", autoreset=False)
    session = Session(env, controllers={"own": towards} if own else {}, seed=0)
    begun = time.thread_time()
    session.run(Unwatched(lambda frame, number: [], seconds=1.0))
    assert time.thread_time() - begun < 0.5


def test_watchers_are_called_and_their_messages_shown(shared_env: SharedEnv) -> None:
    session = Session(shared_env("point_mass"), watchers=[lambda: ["news"]])
    window = run(session, until(lambda frame: "news" in frame.messages))
    assert window.messages == ["news"]


def test_wrong_arguments_are_refused(shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    env = shared_env("hopper", nworld=2)
    with pytest.raises(ValueError, match="there is no world 2: there are 2 worlds, 0 to 1"):
        Session(env, world=2)
    with pytest.raises(ValueError, match="env must be of type Env"):
        Session("hopper")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the controller 'p' must return actions of shape \\(2, 3\\)"):
        Session(env, controllers={"p": lambda obs: obs})
    with pytest.raises(ValueError, match="the controller 'p' failed: .* called with the observations of 'hopper'"):
        Session(env, controllers={"p": lw.GaussianPolicy(3, 3)})
    with pytest.raises(ValueError, match="the controller 'p' failed: KeyError: 'x': it was called with the obs"):
        Session(env, controllers={"p": lambda obs: {}["x"]})
    with pytest.raises(ValueError, match="the controller 'p' must be callable, not int 3"):
        Session(env, controllers={"p": 3})
    with pytest.raises(ValueError, match="the controller 'p' plans for 2 plants, and a controller has one world here"):
        Session(env, controllers={"p": lw.MPPI("hopper", horizon=2, samples=2, plants=2)})
    with pytest.raises(ValueError, match="no site and no body 'nose' to trace"):
        Session(env, controllers={"mppi": lw.MPPI("hopper", horizon=2, samples=2)}, trace="nose")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert chosen_graphics(None) == "web"
    with pytest.raises(ValueError, match="there is no display for a native window"):
        chosen_graphics("native")
    with pytest.raises(ValueError, match="gfx must be 'web' or 'native', not 'x'"):
        chosen_graphics("x")
