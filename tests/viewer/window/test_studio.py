import contextlib
import time
from collections.abc import Callable

import pytest
from mujoco.studio import web_viewer
from mujoco.studio.web import web_server
from websockets.sync.client import connect

from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.server import PageServer, PrivateSocket


def test_viewer_raises_an_error_if_studio_listens_on_every_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a later version of studio that does not call ``bind_public_socket``."""
    for name in ("bind_public_socket", "bind_loopback_socket", "serve"):
        monkeypatch.setattr(web_server, name, getattr(web_server, name))
    for name in ("__init__", "close"):
        monkeypatch.setattr(web_viewer.WebViewer, name, lambda *arguments, **options: None)
    with pytest.raises(RuntimeError, match="every address"):
        studio.Screen().run(studio.Plugin(), title="", server=PageServer())


def test_at_most_two_states_wait_for_a_slow_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page acknowledges each state that it has drawn. This one acknowledges only the first state that it receives."""
    received = states_of_a_second(monkeypatch, lambda: time.monotonic_ns().to_bytes(8), acknowledged=1)
    assert len(received) == 3 and received == sorted(received)


def test_equal_states_are_repeated_so_that_a_page_of_a_paused_session_stays_connected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(studio, "REPEAT", 0.25)
    received = states_of_a_second(monkeypatch, lambda: b"equal", acknowledged=100)
    assert 2 <= len(received) <= 5


def states_of_a_second(
    monkeypatch: pytest.MonkeyPatch, state: Callable[[], bytes], *, acknowledged: int
) -> list[bytes]:
    """Send states for a second, and return those that a page receives. It acknowledges the first ones."""
    page, received = PageServer(), []
    monkeypatch.setattr(web_server, "serve", page.serve)
    server = studio.WebServer(PrivateSocket(), PrivateSocket(), mjb_data=b"model")
    server.start()
    address = page.instructions[0].removeprefix("viewer: http")
    try:
        with connect(f"ws{address}state?sid=a", open_timeout=20) as tab:
            end = time.monotonic() + 1.0  # the server stops waiting for an acknowledgement after 2 s
            while time.monotonic() < end:
                server.update_state(state())
                with contextlib.suppress(TimeoutError):
                    if isinstance(message := tab.recv(timeout=0.01), bytes):
                        received.append(message)
                        if len(received) <= acknowledged:
                            tab.send("state_ack")
    finally:
        server.stop()
    return received
