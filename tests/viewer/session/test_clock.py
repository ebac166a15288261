import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from conftest import SharedEnv
from memory_window import MemoryWindow, run
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.viewer.commands import Command, close, command, set_paused, set_speed, set_video
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viz import renderer


def test_session_obeys_the_commands_set_speed_and_set_paused(shared_env: SharedEnv) -> None:
    window = run(
        Session(shared_env("point_mass")),
        [command(set_speed, 8.0)],
        lambda frame: frame.status.measured_speed > 4,
        [command(set_paused, True)],
        lambda frame: frame.status.paused,
        [command(close)],
    )
    assert len({frame.status.step for frame in window.frames if frame.status.paused}) == 1


def test_failed_video_is_reported_as_a_message(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(renderer, "backends", lambda: ["nonsense"])
    session = Session(shared_env("point_mass"), seed=0)
    window = run(session, [command(set_video, {})], lambda frame: bool(frame.messages))
    assert window.messages[0].startswith("no video: this machine cannot render")
    assert window.frames[-1].status.video is None


def test_view_on_a_busy_port_leaves_no_thread(shared_env: SharedEnv) -> None:
    env, mppi = shared_env("point_mass", nworld=3), lw.MPPI("point_mass", horizon=4, samples=4)
    with socket.create_server(("127.0.0.1", 0)) as busy:
        before = threading.enumerate()
        with pytest.raises(ValueError, match="port"):
            lw.view(env, controllers={"mppi": mppi}, port=busy.getsockname()[1])
    assert [thread.name for thread in threading.enumerate() if thread not in before] == []


@pytest.mark.parametrize("controllers", [{}, {"own": towards}])
def test_session_without_an_open_page_uses_little_cpu_time(
    shared_env: SharedEnv, controllers: dict[str, object]
) -> None:
    class Unwatched(MemoryWindow):
        wants_frame = False

        def is_open(self) -> bool:
            return time.monotonic() < self.end

        def commands(self) -> list[Command]:
            return []

    session = Session(shared_env("point_mass", autoreset=False), controllers=controllers, seed=0)
    begun = time.thread_time()
    session.run(Unwatched(lambda frame, number: [], seconds=0.5))
    assert time.thread_time() - begun < 0.25


def test_session_calls_watchers_and_shows_their_messages(shared_env: SharedEnv) -> None:
    session = Session(shared_env("point_mass"), watchers=[lambda: ["news"]])
    window = run(session, lambda frame: "news" in frame.messages)
    assert window.messages == ["news"]


def test_invalid_session_arguments_raise_an_error(shared_env: SharedEnv) -> None:
    env, small = shared_env("hopper", nworld=2), dict(horizon=2, samples=2)
    wrong: list[tuple[dict[str, Any], str]] = [
        (dict(env="hopper"), "env must be of type Env"),
        (
            dict(controllers={"p": lambda obs: obs}),
            "'p' does not fit .* a float32 tensor of shape \\(2, 3\\)",
        ),
        (
            dict(controllers={"p": lw.GaussianPolicy(3, 3)}),
            "'p' does not fit .* cannot take the observations",
        ),
        (dict(controllers={"p": lambda obs: {}["x"]}), "'p' does not fit the task 'hopper': KeyError: 'x'"),
        (dict(controllers={"p": 3}), "'p' does not fit .*: a controller must be callable"),
        (dict(controllers={"p": lw.MPPI("hopper", plants=2, **small)}), "'p' does not fit .* plans for 2 plants"),
    ]
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            Session(**{"env": env} | options)
