import contextlib
import gzip
import os
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mujoco.studio.web import web_server
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lyceum_warp.viewer.window import server as module
from lyceum_warp.viewer.window.server import PageServer, PrivateSocket

UPGRADE = (
    "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZQ==\r\nSec-WebSocket-Version: 13"
)
HANDSHAKE = bytes(120)
"""The first message of a tab, which studio expects to have this size."""


class Studio:
    """Studio's server behind a page server. An echo takes the place of studio's user interface."""

    def __init__(self, page: PageServer) -> None:
        self.page, self.private = page, PrivateSocket()
        self.address = page.instructions[0].removeprefix("viewer: ")
        self.secret, self.port = self.address.split("/")[3], int(self.address.split("/")[2].partition(":")[2])
        self.server = web_server.WebServer(PrivateSocket(), self.private, mjb_data=b"model")
        self.server.start()
        wait_until(lambda: self.status("GET / HTTP/1.1") == 403)
        threading.Thread(target=self.echo, daemon=True).start()  # the private socket now listens

    def echo(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                with socket.create_connection(self.private.getsockname()) as connection:
                    while data := connection.recv(2**16):
                        connection.sendall(data)

    def get(self, path: str = "", **headers: str) -> bytes:
        request = urllib.request.Request(self.address + path, headers=headers)
        with urllib.request.urlopen(request, timeout=10) as response:
            content: bytes = response.read()
        return content

    def status(self, head: str) -> int:
        """Return the status of the response to a request, or 0 if there is none. SECRET stands for the secret."""
        answer = b""
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=10) as client:
            client.sendall(head.replace("SECRET", self.secret).encode("latin-1") + b"\r\nHost: x\r\n\r\n")
            while data := client.recv(2**16):
                answer += data
        return int(answer.split()[1]) if answer else 0

    def tab(self, path: str) -> ClientConnection:
        return connect(self.address.replace("http", "ws", 1) + path, max_size=None)


@pytest.fixture
def studio(monkeypatch: pytest.MonkeyPatch) -> Iterator[Studio]:
    page = PageServer(title="a & b")
    monkeypatch.setattr(web_server, "serve", page.serve)
    opened = Studio(page)
    yield opened
    opened.server.stop()


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# requests


def test_page_and_model_are_served_below_the_secret_path(studio: Studio) -> None:
    assert len(studio.secret) == 43  # 32 bytes
    page = studio.get()
    assert b'<head><script src="page.js"></script>' in page and b"<title>a &amp; b</title>" in page
    assert gzip.decompress(studio.get(**{"Accept-Encoding": "gzip"})) == page
    assert b"force_control" in studio.get("page.js") and studio.get("model") == b"model"
    assert studio.status("GET /SECRET/web_client.js HTTP/1.1") == 200


@pytest.mark.parametrize("path", [
    "/", "/index.html", "/model", "/ui", "/state", "/WRONG/", "/SECRETx/", "//SECRET/", "/x/SECRET/", "/?SECRET",
    "/page.js", "/saved/x", "/%53ECRET/",
])  # fmt: skip
def test_requests_without_the_secret_are_refused(studio: Studio, path: str) -> None:
    assert studio.status(f"GET {path} HTTP/1.1") == studio.status(f"GET {path} HTTP/1.1\r\n{UPGRADE}") == 403


@pytest.mark.parametrize("head", [
    "GET /SECRET/ HTTP/1.1\r\nContent-Length: 44", f"GET /SECRET/drop HTTP/1.1\r\n{UPGRADE}",
    f"GET /SECRET/drop?sid=a HTTP/1.1\r\n{UPGRADE}", "GET /SECRET/ HTTP/1.1\r\nX: " + "a" * 9000,
    "GET /SECRET/ HTTP/1.1\r\n" + "\r\n".join(f"X-{i}: {i}" for i in range(130)), "GET /SECRET/../../x HTTP/1.1",
])  # fmt: skip
def test_requests_that_studio_must_not_see_are_refused(studio: Studio, head: str) -> None:
    assert studio.status(head) not in (101, 200)


def test_only_offered_files_are_sent(studio: Studio, tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"offered")
    (tmp_path / "secret.txt").write_bytes(b"not offered")
    with studio.tab("state?sid=a") as tab:
        tab.recv(timeout=10)  # the roster
        studio.page.offer(str(tmp_path / "video.mp4"))
        wait_until(lambda: tab.recv(timeout=10) == "saved=video.mp4")
    assert studio.get("saved/video.mp4") == b"offered"
    for name in ("secret.txt", "../secret.txt", "video.mp4/../secret.txt", str(tmp_path / "secret.txt")):
        with pytest.raises(urllib.error.HTTPError, match="404|403"):
            studio.get(f"saved/{name}")


# tabs


def test_slow_page_gets_the_whole_of_a_large_file(studio: Studio, tmp_path: Path) -> None:
    size = 2**25  # far more than the sockets' buffers hold
    (tmp_path / "large").write_bytes(bytes(size))
    studio.page.offer(str(tmp_path / "large"))
    with socket.create_connection(("127.0.0.1", studio.port), timeout=20) as client:
        client.sendall(f"GET /{studio.secret}/saved/large HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        received = len(client.recv(2**16))  # the response has begun
        loop, later = studio.page._loop, threading.Event()
        loop.call_soon_threadsafe(setattr, loop, "time", lambda: time.monotonic() + 60)  # a minute passes
        loop.call_soon_threadsafe(lambda: loop.call_soon(later.set))
        assert later.wait(20)
        while data := client.recv(2**20):
            received += len(data)
    assert received > size


def test_too_large_message_closes_the_websocket(studio: Studio) -> None:
    with studio.tab("state?sid=a") as tab, pytest.raises(ConnectionClosed):
        tab.send(bytes(2**20 + 1))
        while True:
            tab.recv(timeout=10)


def test_frames_are_due_while_a_tab_connects_and_after_each_of_its_inputs(studio: Studio) -> None:
    def frames_due() -> int:
        return next(i for i in range(10) if not studio.page.take_frame(0.0) or i == 9)

    assert frames_due() == 0
    with studio.tab("ui?sid=a") as tab:
        wait_until(lambda: frames_due() == 9)
        for message in (HANDSHAKE, b"input"):
            tab.send(message)
            assert tab.recv(timeout=10) == message
            assert frames_due() == module.FRAMES and frames_due() == 0
    with studio.tab("ui?sid=b"):
        wait_until(lambda: frames_due() == 9)
    wait_until(lambda: frames_due() == 0)  # the tab was closed before its first input


def test_silent_tab_is_reported_and_loses_control_to_another_tab(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "QUIET_SECONDS", 0.3)
    quiet: list[float] = []
    studio.page.on_look = lambda looks: None if looks else quiet.append(time.monotonic())
    with studio.tab("state?sid=a"), studio.tab("ui?sid=a") as tab:
        tab.send(HANDSHAKE)
        tab.recv(timeout=10)
        wait_until(lambda: len(quiet) == 1)
        tab.send(b"input")
        assert tab.recv(timeout=10) == b"input"  # without another tab, it keeps control
        with studio.tab("state?sid=b"), pytest.raises(ConnectionClosed, match="4001.*hidden"):
            tab.send(b"input")  # the last input may be older than QUIET_SECONDS
            while True:
                tab.recv(timeout=10)


def test_gamepad_is_reported_and_other_axes_are_ignored(studio: Studio) -> None:
    axes: list[list[float]] = []
    studio.page.on_gamepad = axes.append
    with studio.tab("state?sid=a") as tab:
        for text in ("nan,0,0", "2,0,0", "1,0", "x", "0.5,-1,0"):
            tab.send(f"gamepad={text}")
        wait_until(lambda: bool(axes))
    assert axes == [[0.5, -1.0, 0.0]]


# addresses and ports


@pytest.mark.parametrize("ssh, shown, target", [
    ("198.51.100.7 50000 203.0.113.9 2222", "203.0.113.9", "-p 2222 ada@203.0.113.9"),
    ("", socket.gethostname(), f"ada@{socket.gethostname()}"),
])  # fmt: skip
def test_viewer_prints_an_address_and_an_ssh_command(
    ssh: str, shown: str, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("getpass.getuser", lambda: "ada")
    monkeypatch.setenv("SSH_CONNECTION", ssh)
    for host, address in (("127.0.0.1", "127.0.0.1"), ("0.0.0.0", shown), ("::", shown)):
        with contextlib.closing(PageServer(host=host)) as page:
            first, *others = page.instructions
            port, secret = first.removeprefix(f"viewer: http://{address}:").strip("/").split("/")
            line = f"ssh -C -N -L {port}:127.0.0.1:{port} {target}"
            if host == "127.0.0.1":
                assert others == [f"from another machine: {line}"]
            else:
                assert "not encrypted" in others[0] and line in others[1]
                assert f"http://127.0.0.1:{port}/{secret}/" in others[2]


def test_free_port_is_found_and_invalid_port_or_host_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PORTS", 1)
    with contextlib.closing(PageServer()) as one, contextlib.closing(PageServer()) as other:
        used, free = (int(page.instructions[0].split("/")[2].partition(":")[2]) for page in (one, other))
        assert used != free
        for options, value in (
            ({"port": used}, str(used)), ({"port": -1}, "-1"), ({"port": 65536}, "65536"),
            ({"host": "192.0.2.1"}, "192.0.2.1"), ({"host": "no.such.host.invalid"}, "no.such.host.invalid"),
        ):  # fmt: skip
            with pytest.raises(ValueError, match=value):
                PageServer(**options)  # type: ignore[arg-type]


@pytest.mark.skipif(os.getuid() != 0, reason="only root can start a process of another user")
def test_other_users_cannot_connect_to_a_private_socket() -> None:
    with PrivateSocket() as private:
        private.listen()
        if (child := os.fork()) == 0:
            with contextlib.suppress(OSError):
                os.setuid(65534)
                socket.create_connection(private.getsockname(), timeout=10).recv(1)
            os._exit(0)
        with pytest.raises(ConnectionAbortedError, match="another user"):
            private.accept()
        os.waitpid(child, 0)
        with socket.create_connection(private.getsockname()) as client:
            connection, address = private.accept()
            assert address == client.getsockname()
            connection.close()
