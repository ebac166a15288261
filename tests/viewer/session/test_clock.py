import socket
import threading
from typing import Any

import pytest
from conftest import SharedEnv
from memory_window import run

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, set_ghosts, set_watched
from lyceum_warp.viewer.protocol import Ghosts
from lyceum_warp.viewer.session.clock import Session


def test_view_on_a_busy_port_leaves_no_thread(shared_env: SharedEnv) -> None:
    env, mppi = shared_env("point_mass", nworld=3), lw.MPPI("point_mass", horizon=4, samples=4)
    with socket.create_server(("127.0.0.1", 0)) as busy:
        before = threading.enumerate()
        with pytest.raises(ValueError, match="port"):
            lw.view(env, controllers={"mppi": mppi}, port=busy.getsockname()[1])
    assert [thread.name for thread in threading.enumerate() if thread not in before] == []


def test_session_calls_watchers_and_shows_their_messages(shared_env: SharedEnv) -> None:
    session = Session(shared_env("point_mass"), watchers=[lambda: ["news"]])
    window = run(session, lambda frame: "news" in frame.messages)
    assert window.messages == ["news"]


def test_worlds_sleep_while_no_page_is_visible(shared_env: SharedEnv) -> None:
    session = Session(shared_env("point_mass"))
    steps: list[int] = []
    window = run(
        session, [command(set_watched, False)], lambda frame: not session.stage.watched,
        [command(set_ghosts, Ghosts())], lambda frame: bool(steps.append(session.stage.steps)) or len(steps) == 5,
        [command(set_watched, True)], lambda frame: session.stage.steps > steps[-1],
    )  # fmt: skip
    assert len(set(steps)) == 1 and window.closed == 1


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
