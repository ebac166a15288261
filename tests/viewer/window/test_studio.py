import contextlib
import time

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
    page, received = PageServer(), []
    monkeypatch.setattr(web_server, "serve", page.serve)
    server = studio.WebServer(PrivateSocket(), PrivateSocket(), mjb_data=b"model")
    server.start()
    address = page.instructions[0].removeprefix("viewer: http")
    try:
        with connect(f"ws{address}state?sid=a", open_timeout=20) as tab:
            end = time.monotonic() + 1.0  # the server stops waiting for an acknowledgement after 2 s
            while time.monotonic() < end:
                server.update_state(time.monotonic_ns().to_bytes(8))
                with contextlib.suppress(TimeoutError):
                    if isinstance(message := tab.recv(timeout=0.01), bytes):
                        received.append(message)
                        if len(received) == 1:
                            tab.send("state_ack")
    finally:
        server.stop()
    assert len(received) == 3 and received == sorted(received)
