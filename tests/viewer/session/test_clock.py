"""The loop of a session, with real worlds and a window in memory."""

import socket
import threading
import time
from pathlib import Path

import pytest
from conftest import SharedEnv
from memory_window import MemoryWindow, run, until
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import Command, Frame
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.show import chosen_graphics
from lyceum_warp.viz.video import Recorder

PLANNER = dict(horizon=8, samples=6, temperature=0.01, noise=0.3)


def test_speed_and_pause_hold(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass")
    session = Session(env)
    window = run(
        session,
        [protocol.SetSpeed(8.0)],
        until(lambda frame: frame.status.measured_speed > 4),
        [protocol.SetPaused(True)],
        until(lambda frame: frame.status.paused),
        [protocol.SetSpeed(100.0)],
        until(lambda frame: frame.status.speed == 16.0),
        [protocol.Close()],
        lambda frame: [],
    )
    paused = [frame for frame in window.frames if frame.status.paused]
    assert len({frame.status.step for frame in paused}) == 1


def test_an_exception_does_not_wait_for_videos(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C as well: drawing what is left may take minutes."""
    monkeypatch.chdir(tmp_path)
    session = Session(shared_env("point_mass"), seed=0)

    def interrupted(frame: Frame) -> list[Command]:
        if frame.status.video is None:
            return [protocol.SetVideo(True)]
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
    session.obey(protocol.SetVideo(True))
    assert "No space left on device" in session.stage.frame().messages[0]
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Recorder, "add", full)
    window = run(session, [protocol.SetVideo(True)], until(lambda frame: bool(frame.messages)))
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
