"""The server in front of the viewer: what it passes on, and each attack that it must refuse."""

import contextlib
import http.client
import http.cookiejar
import ipaddress
import os
import re
import socket
import stat
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from lyceum_warp.viewer.window import proxy as module
from lyceum_warp.viewer.window import sockets as sockets_module
from lyceum_warp.viewer.window.proxy import Front
from lyceum_warp.viewer.window.sockets import private_socket

KEY = "dGhlIHNhbXBsZSBub25jZQ=="


class Upstream:
    """A private server that keeps every byte it gets; it opens WebSockets and sends their bytes back."""

    def __init__(self, answer: bytes | None = None) -> None:
        self.answer = answer
        self.received: list[bytes] = []
        self.connections: list[socket.socket] = []
        self.ended = 0
        self.listener = private_socket()
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                self.connections.append(connection)
                self.received.append(b"")
                threading.Thread(target=self.serve, args=(connection, len(self.received) - 1), daemon=True).start()

    def serve(self, connection: socket.socket, index: int) -> None:
        with contextlib.suppress(OSError):
            while data := connection.recv(65536):
                self.received[index] += data
                head, end, rest = self.received[index].partition(b"\r\n\r\n")
                if not end:
                    continue
                if self.answer is not None:
                    connection.sendall(self.answer)
                    connection.shutdown(socket.SHUT_WR)
                elif b"Upgrade: websocket" in head:
                    echo = data if len(data) <= len(rest) else rest
                    opening = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n"
                    connection.sendall(echo if rest else opening)
                else:
                    connection.sendall(
                        b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\nAccess-Control-Allow-Origin: *\r\n\r\nrobot"
                    )
                    connection.shutdown(socket.SHUT_WR)
        self.ended += 1

    def kill(self) -> None:
        for opened in (self.listener, *self.connections):
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()


@pytest.fixture
def upstream() -> Iterator[Upstream]:
    server = Upstream()
    yield server
    server.kill()


@pytest.fixture
def front(upstream: Upstream) -> Iterator[Front]:
    with Front() as opened:
        opened.start(upstream.listener.getsockname())
        yield opened


def token(front: Front) -> str:
    return front.address.partition("token=")[2]


def request(front: Front, head: str, *, rest: bytes = b"") -> bytes:
    """Everything that the front answers to a head, whose lines are separated by line breaks."""
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        client.sendall(head.replace("\n", "\r\n").encode("latin-1") + b"\r\n\r\n" + rest)
        answer = b""
        while data := client.recv(65536):
            answer += data
        return answer


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


def entered(front: Front, host: str = "") -> tuple[str, str]:
    """The cookie that the token is exchanged for, and the path that it belongs to."""
    host = host or f"127.0.0.1:{front.port}"
    answer = request(front, f"GET /?token={token(front)} HTTP/1.1\nHost: {host}").decode()
    found = re.search(r"\r\nSet-Cookie: ([^;]*); Path=(/[^;]*)/;", answer)
    assert found is not None
    return found[1], found[2]


def cookie(front: Front, host: str = "") -> str:
    return entered(front, host)[0]


def below(front: Front, path: str = "/") -> str:
    """The path of a page as a browser asks for it."""
    return entered(front)[1] + path


def get(front: Front, path: str = "/", *headers: str, host: str = "", key: str | None = None) -> bytes:
    """The answer to GET below the right path, with the right cookie or with another one."""
    host = host or f"127.0.0.1:{front.port}"
    own, before = entered(front)
    key = own if key is None else key
    path = before + path if path.startswith("/") and "?token=" not in path else path
    return request(front, "\n".join([f"GET {path} HTTP/1.1", f"Host: {host}", f"Cookie: {key}", *headers]))


def upgrade(path: str = "/ui", *headers: str) -> list[str]:
    fixed = ["Upgrade: websocket", "Connection: keep-alive, Upgrade", f"Sec-WebSocket-Key: {KEY}"]
    return [path, *fixed, "Sec-WebSocket-Version: 13", *headers]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# the secret


def test_the_token_becomes_a_cookie_and_leaves_the_address(front: Front, upstream: Upstream) -> None:
    answer = request(front, f"GET /?token={token(front)}&a=1 HTTP/1.1\nHost: localhost:{front.port}").decode()
    assert answer.startswith("HTTP/1.1 303 ")
    target = re.search(r"\r\nLocation: (/[\w-]{43}/)\?a=1\r\n", answer)
    given = re.search(r"\r\nSet-Cookie: (.*)\r\n", answer)
    assert target is not None
    assert given is not None
    assert given[1].startswith("lyceum-warp=")
    assert given[1].endswith(f"; Path={target[1]}; HttpOnly; SameSite=Strict")
    assert target[1].strip("/") not in cookie(front)
    assert token(front) not in answer
    assert not upstream.received
    assert get(front).endswith(b"\r\n\r\nrobot")


def test_an_address_has_32_random_bytes() -> None:
    with Front() as one, Front() as other:
        assert token(one) != token(other)
        assert len(token(one)) == 43


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=WRONG", "/?token=OTHER", "/?token=TOKEN&token=WRONG",
                                  "/?token=TOKEN&token=TOKEN", "/model", "/model?token=WRONG", "/?tokenx=TOKEN",
                                  "/?token=token\xe9"])  # fmt: skip
def test_requests_without_the_right_token_are_refused(front: Front, upstream: Upstream, path: str) -> None:
    with Front() as other:
        path = path.replace("TOKEN", token(front)).replace("OTHER", token(other))
        assert status(request(front, f"GET {path} HTTP/1.1\nHost: 127.0.0.1")) in (400, 403)
    assert not upstream.received


@pytest.mark.parametrize("key", ["", "lyceum-warp=", "lyceum-warp=wrong", "lyceum-warp=TOKEN", "NAME=VALUEx", "x=VALUE",
                                 "lyceum-warp=PATH", "lyceum-warp=VALUE\xe9"])  # fmt: skip
def test_requests_without_the_right_cookie_are_refused(front: Front, upstream: Upstream, key: str) -> None:
    name, _, value = cookie(front).partition("=")
    path = below(front, "").strip("/")
    for word, meaning in (("NAME", name), ("VALUE", value), ("PATH", path), ("TOKEN", token(front))):
        key = key.replace(word, meaning)
    assert status(get(front, key=key)) == 403
    assert status(get(front, *upgrade(), key=key)) == 403
    assert not upstream.received


def test_another_viewers_cookie_is_refused_and_does_not_disturb(front: Front, upstream: Upstream) -> None:
    with Front() as other:
        other.start(upstream.listener.getsockname())
        assert status(get(front, key=cookie(other))) == 403
        both = f"{cookie(front)}; {cookie(other)}; theme=dark"
        assert status(get(front, key=both)) == status(get(other, key=both)) == 200


@pytest.mark.parametrize("path", ["/", "/index.html", "//", "/WRONG/", "/PATH", "/PATHx/", "//PATH/", "/x/../PATH/",
                                  "/VALUE/", "/model"])  # fmt: skip
def test_the_cookie_without_the_right_path_is_refused(front: Front, upstream: Upstream, path: str) -> None:
    key, before = entered(front)
    path = path.replace("PATH", before.strip("/")).replace("VALUE", key.partition("=")[2])
    head = f"GET {path} HTTP/1.1\nHost: 127.0.0.1\nCookie: {key}"
    assert status(request(front, head)) == 403
    assert not upstream.received


class Jar(http.cookiejar.CookieJar):
    """Cookies as a browser sends them: to every port of their host, below their path."""

    def sent_to(self, address: str) -> str | None:
        asked = urllib.request.Request(address)
        self.add_cookie_header(asked)
        return asked.get_header("Cookie")


def test_another_port_of_the_host_is_not_sent_the_cookie(front: Front) -> None:
    """Other users of the machine may listen there."""
    jar = Jar()
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
    with browser.open(front.address) as page:
        assert page.read() == b"robot"
        assert jar.sent_to(f"http://127.0.0.1:{front.port}{below(front)}") == cookie(front)
    for path in ("/", "/ui", "/state", "/model", "/lyceum-warp/", "/index.html"):
        assert jar.sent_to(f"http://127.0.0.1:{front.port + 1}{path}") is None


def test_a_viewer_of_before_on_the_same_port_does_not_disturb(front: Front) -> None:
    assert status(get(front, key=f"lyceum-warp=stale; {cookie(front)}; lyceum-warp=other")) == 200
    assert status(get(front, host="127.0.0.1:9001")) == 200  # a forwarded port


# the page


def test_the_page_asks_below_its_path() -> None:
    page = b"<!doctype html><html><head><title>robot</title></head></html>"
    upstream = Upstream(b"HTTP/1.1 200 OK\r\nContent-Type: text/html; charset=utf-8\r\nContent-Length: %d\r\n\r\n%s"
                        % (len(page), page))  # fmt: skip
    with Front() as front:
        front.start(upstream.listener.getsockname())
        head, _, body = get(front).partition(b"\r\n\r\n")
        assert body.startswith(b"<!doctype html><html><head><script>")
        assert body.endswith(b"</script><title>robot</title></head></html>")
        assert head.lower().count(b"content-length:") == 1
        assert b"Content-Length: %d\r\n" % len(body) in head
    upstream.kill()


@pytest.mark.parametrize("page", [b"<head>", b"<title>robot</title>      ", b"<head>" + bytes(2**20)])
def test_a_page_that_cannot_be_changed_is_reported(page: bytes) -> None:
    """One is incomplete, one has no head, one is too large."""
    upstream = Upstream(b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 26\r\n\r\n" + page)
    with Front() as front:
        front.start(upstream.listener.getsockname())
        assert status(get(front)) == 502
    upstream.kill()


# other sites


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1", "file://",
                                    "http://localhost:PORT", "http://127.0.0.1:PORT.evil.example",
                                    "http://127.0.0.1:PORT/", ""])  # fmt: skip
def test_foreign_origins_are_refused(front: Front, upstream: Upstream, origin: str) -> None:
    header = f"Origin: {origin.replace('PORT', str(front.port))}"
    assert status(get(front, "/model", header)) == 403
    assert status(get(front, *upgrade("/state", header))) == 403
    assert status(get(front, f"/?token={token(front)}", header)) == 403
    assert not upstream.received


@pytest.mark.parametrize("headers", [
    ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors", "Sec-Fetch-Dest: script"),
    ("Sec-Fetch-Site: same-site", "Sec-Fetch-Mode: no-cors", "Sec-Fetch-Dest: image"),
    ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: iframe"),
    ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: websocket", "Sec-Fetch-Dest: websocket"),
])  # fmt: skip
def test_what_another_sites_page_embeds_is_refused(front: Front, headers: tuple[str, ...]) -> None:
    assert status(get(front, "/model", *headers)) == 403
    assert status(get(front, *upgrade("/state", *headers))) == 403


def test_a_link_on_another_page_leads_to_the_viewer_if_it_has_the_token(front: Front, upstream: Upstream) -> None:
    link = ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: document")
    assert status(get(front, "/", *link, key="")) == 403
    answer = get(front, f"/?token={token(front)}", *link, key="").decode()
    assert answer.startswith("HTTP/1.1 200 ")
    assert "Set-Cookie: " in answer
    assert f'content="0; url={below(front)}"' in answer
    assert not upstream.received


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:PORT", "127.0.0.1.evil.example", "localhost.evil.example:PORT", "localhost."]
)
def test_names_that_are_not_this_machines_are_refused(front: Front, upstream: Upstream, host: str) -> None:
    host = host.replace("PORT", str(front.port))
    assert status(request(front, f"GET /?token={token(front)} HTTP/1.1\nHost: {host}")) == 421
    assert status(request(front, f"GET {below(front)} HTTP/1.1\nHost: {host}\nCookie: {cookie(front)}")) == 421
    assert not upstream.received


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.0.0.1:9000", "localhost:9000", "LOCALHOST:80", "[::1]:9000", "192.168.0.7:8080"]
)
def test_addresses_of_this_machine_are_accepted_at_any_port(front: Front, host: str) -> None:
    assert status(get(front, "/", f"Origin: http://{host.lower()}", host=host)) == 200


def test_other_sites_cannot_read_or_embed_the_page(front: Front) -> None:
    answer = get(front, "/model").decode().lower()
    assert "access-control-allow-origin" not in answer
    assert "\r\nx-frame-options: deny\r\n" in answer
    assert "\r\ncross-origin-resource-policy: same-origin\r\n" in answer
    assert "\r\nreferrer-policy: no-referrer\r\n" in answer


# requests


@pytest.mark.parametrize("path", ["/drop", "/drop?sid=1"])
def test_models_cannot_be_dropped(front: Front, upstream: Upstream, path: str) -> None:
    assert status(get(front, path)) == 403
    assert status(get(front, *upgrade(path))) == 403
    assert not upstream.received


@pytest.mark.parametrize(
    "path",
    [
        "//drop",
        "/./drop",
        "/x/../drop",
        "/%64rop",
        "/drop%20",
        "/..",
        "/assets/../../x",
        "/\\drop",
        "http://127.0.0.1/",
    ],
)
def test_paths_in_other_spellings_are_refused(front: Front, upstream: Upstream, path: str) -> None:
    assert status(get(front, path)) in (400, 404)
    assert status(get(front, *upgrade(path))) in (400, 404)
    assert not upstream.received


@pytest.mark.parametrize("path", ["/", "/model", "/upload"])
def test_other_websockets_are_refused(front: Front, upstream: Upstream, path: str) -> None:
    assert status(get(front, *upgrade(path))) == 404
    assert not upstream.received


@pytest.mark.parametrize(
    "path", ["/index.html", "/model?crc32=1&total_bytes", "/assets/AtkinsonHyperlegibleNext[wght].ttf"]
)
def test_pages_are_passed_on(front: Front, upstream: Upstream, path: str) -> None:
    assert get(front, path, "X-Other: 1").endswith(b"\r\n\r\nrobot")
    assert upstream.received == [f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode()]


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "HEAD", "OPTIONS", "CONNECT", "TRACE"])
def test_only_get_is_allowed(front: Front, upstream: Upstream, method: str) -> None:
    head = f"{method} {below(front)} HTTP/1.1\nHost: 127.0.0.1:{front.port}\nCookie: {cookie(front)}"
    assert status(request(front, head)) == 405
    assert not upstream.received


@pytest.mark.parametrize("head", [
    "GET / HTTP/1.0\nHost: HOST", "GET / HTTP/2\nHost: HOST", "GET /\nHost: HOST", "get / HTTP/1.1\nHost: HOST",
    "GET  / HTTP/1.1\nHost: HOST", "GET /a b HTTP/1.1\nHost: HOST", "GET / HTTP/1.1", "GET / HTTP/1.1\nHost:",
    "GET / HTTP/1.1\nHost: HOST\nHost: HOST",
    "GET / HTTP/1.1\nHost : HOST", "GET / HTTP/1.1\nHost: HOST\n folded: 1", "GET / HTTP/1.1\nHost: HOST\nX: a\x00b",
    "GET / HTTP/1.1\nHost: HOST\nX: a\rb", "GET / HTTP/1.1\nHost: HOST\nno colon", "GET / HTTP/1.1\nHost: HOST\n: 1",
    "GET / HTTP/1.1\nHost: a@HOST", "GET / HTTP/1.1\nHost: HOST/", "\x16\x03\x01\x02", "", "PRI * HTTP/2.0",
])  # fmt: skip
def test_malformed_requests_are_refused(front: Front, upstream: Upstream, head: str) -> None:
    head = head.replace("HOST", f"127.0.0.1:{front.port}")
    assert status(request(front, f"{head}\nCookie: {cookie(front)}" if head else head)) == 400
    assert not upstream.received


def test_line_feeds_alone_do_not_separate_headers(front: Front, upstream: Upstream) -> None:
    with socket.create_connection(("127.0.0.1", front.port)) as client:
        text = f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: 1\nCookie: {cookie(front, '127.0.0.1')}\r\n\r\n"
        client.sendall(text.encode())
        assert status(client.recv(65536)) == 400
    assert not upstream.received


@pytest.mark.parametrize(
    "header", ["X: " + "a" * 20_000, "\n".join(f"X-{n}: {n}" for n in range(3000)), "Cookie: " + "a=b; " * 5000]
)
def test_large_heads_are_refused(front: Front, upstream: Upstream, header: str) -> None:
    assert status(request(front, f"GET / HTTP/1.1\nHost: 127.0.0.1\n{header}")) == 431
    assert not upstream.received


def test_an_endless_head_is_refused_without_being_kept(front: Front) -> None:
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        sent = 0
        with contextlib.suppress(OSError):
            while sent < 64 * 2**20:
                sent += client.send(b"a" * 2**16)
        assert sent < 64 * 2**20


# smuggling: no bytes of the client after its request may reach the private server


@pytest.mark.parametrize("header", ["Content-Length: 44", "Content-Length: 0, 44",
                                    "Content-Length: 0\nContent-Length: 44",
                                    "Transfer-Encoding: chunked", "Transfer-Encoding: xchunked",
                                    "Content-Length: 0\nTransfer-Encoding: identity"])  # fmt: skip
def test_requests_with_a_body_are_refused(front: Front, upstream: Upstream, header: str) -> None:
    head = f"GET {below(front)} HTTP/1.1\nHost: 127.0.0.1\nCookie: {cookie(front)}\n{header}"
    assert status(request(front, head, rest=b"0\r\n\r\nGET /drop HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")) == 400
    assert not upstream.received


def test_a_second_request_on_a_connection_is_not_passed_on(front: Front, upstream: Upstream) -> None:
    head = f"GET {below(front)} HTTP/1.1\nHost: 127.0.0.1\nCookie: {cookie(front)}\nConnection: keep-alive"
    answer = request(front, head, rest=b"GET /drop HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert answer.count(b"HTTP/1.1 ") == 1
    assert b"\r\nConnection: close\r\n" in answer
    assert len(upstream.received) == 1
    assert b"drop" not in upstream.received[0]


def test_bytes_after_an_upgrade_that_failed_are_not_passed_on() -> None:
    upstream = Upstream(b"HTTP/1.1 426 Upgrade Required\r\nContent-Length: 0\r\n\r\n")
    with Front() as front:
        front.start(upstream.listener.getsockname())
        path, *headers = upgrade()
        key, before = entered(front)
        head = "\n".join([f"GET {before}{path} HTTP/1.1", "Host: 127.0.0.1", f"Cookie: {key}", *headers])
        assert status(request(front, head, rest=b"GET /drop HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 426
        assert b"drop" not in upstream.received[0]
    upstream.kill()


@pytest.mark.parametrize(
    "header",
    [
        "Upgrade: h2c",
        "Sec-WebSocket-Key: short",
        "Sec-WebSocket-Key: ",
        "Connection: close",
        "Sec-WebSocket-Version: 8",
    ],
)
def test_other_upgrades_are_refused(front: Front, upstream: Upstream, header: str) -> None:
    name = header.partition(":")[0]
    path, *headers = upgrade()
    assert status(get(front, path, *(line for line in headers if not line.startswith(name + ":")), header)) == 400
    assert not upstream.received


def test_headers_of_the_client_do_not_reach_the_private_server(front: Front, upstream: Upstream) -> None:
    get(
        front,
        "/model",
        "X-Forwarded-For: 1",
        "Upgrade-Insecure-Requests: 1",
        "Sec-WebSocket-Extensions: permessage-deflate",
    )
    assert upstream.received[0].count(b"\r\n") == 4
    assert b"Cookie" not in upstream.received[0]


# slow clients, and many


def test_a_slow_head_is_refused(front: Front, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HEAD_SECONDS", 0.3)
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        answer, began = b"", time.monotonic()
        client.settimeout(0.05)
        for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" * 10:  # each byte is in time, all of them are not
            with contextlib.suppress(TimeoutError):
                client.send(bytes([byte]))
                answer += client.recv(65536)
                break
        assert status(answer) == 408
        assert time.monotonic() - began < 5


def test_silent_connections_leave_room_for_others(front: Front, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "UNCHECKED", 8)
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", front.port))) for _ in range(40)]
        assert status(get(front)) == 200
        assert silent[0].recv(1) == b""  # the oldest ones were closed


def test_a_client_that_takes_nothing_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WRITE_SECONDS", 0.3)
    upstream = Upstream(b"HTTP/1.1 200 OK\r\n\r\n" + bytes(64 * 2**20))
    with Front() as front:
        front.start(upstream.listener.getsockname())
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.connect(("127.0.0.1", front.port))
            head = f"GET {below(front)} HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie(front)}\r\n\r\n"
            client.sendall(head.encode())
            wait_until(lambda: upstream.ended == 1)
    upstream.kill()


# WebSockets


def test_a_websocket_carries_bytes_both_ways(front: Front, upstream: Upstream) -> None:
    path, *headers = upgrade("/state?sid=a", f"Origin: http://127.0.0.1:{front.port}")
    lines = [f"GET {below(front, path)} HTTP/1.1", f"Host: 127.0.0.1:{front.port}", f"Cookie: {cookie(front)}"]
    head = "\r\n".join([*lines, *headers])
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        client.sendall(head.encode() + b"\r\n\r\n")
        assert status(client.recv(65536)) == 101
        client.sendall(b"\x81\x05hello")
        assert client.recv(65536) == b"\x81\x05hello"
    assert upstream.received[0].startswith(b"GET /state?sid=a HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n")


@pytest.fixture
def echo() -> Iterator[tuple[Front, list[ServerConnection]]]:
    """A front before a WebSocket server of the library that the viewer uses, and its open connections."""
    opened: list[ServerConnection] = []

    def handle(connection: ServerConnection) -> None:
        opened.append(connection)
        with contextlib.suppress(ConnectionClosed):
            for message in connection:
                connection.send(message)
        opened.remove(connection)

    private = private_socket()
    with serve(handle, sock=private, compression=None, max_size=None) as server, Front() as front:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        front.start(private.getsockname())
        yield front, opened


def open_tab(front: Front, *, origin: str | None = None, key: str | None = None, path: str = "/ui") -> ClientConnection:
    host = f"127.0.0.1:{front.port}"
    return connect(f"ws://{host}{below(front, path)}", origin=origin or f"http://{host}", max_size=None,  # type: ignore[arg-type]
                   additional_headers={"Cookie": cookie(front) if key is None else key})  # fmt: skip


def test_two_tabs_talk_at_once_and_one_may_close(echo: tuple[Front, list[ServerConnection]]) -> None:
    front, opened = echo
    with open_tab(front) as one:
        with open_tab(front, path="/state?sid=b") as two:
            large = os.urandom(3 * 2**20)
            one.send(large)
            two.send("two")
            assert two.recv() == "two"
            assert one.recv() == large
        wait_until(lambda: len(opened) == 1)
        one.send(b"still here")
        assert one.recv() == b"still here"
    wait_until(lambda: not opened)


def test_a_tab_that_disappears_is_noticed_by_the_private_server(echo: tuple[Front, list[ServerConnection]]) -> None:
    front, opened = echo
    tab = open_tab(front)
    wait_until(lambda: len(opened) == 1)
    tab.socket.shutdown(socket.SHUT_RDWR)  # as the system does for a killed browser
    wait_until(lambda: not opened)


def test_a_browser_that_controls_and_falls_silent_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "QUIET_SECONDS", 0.4)
    quiet: list[float] = []
    upstream = Upstream()
    with Front() as front:
        front.start(upstream.listener.getsockname(), on_quiet=lambda: quiet.append(time.monotonic()))
        path, *headers = upgrade("/ui?sid=a")
        lines = [f"GET {below(front, path)} HTTP/1.1", "Host: 127.0.0.1", f"Cookie: {cookie(front)}", *headers]
        with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
            client.sendall("\r\n".join(lines).encode() + b"\r\n\r\n")
            assert status(client.recv(65536)) == 101
            for _ in range(10):
                client.sendall(b"input")
                time.sleep(0.08)
            assert not quiet
            wait_until(lambda: len(quiet) == 1)  # hidden, or cut off
            client.sendall(b"input")
        wait_until(lambda: len(quiet) == 2)  # closed
        time.sleep(0.6)
        assert len(quiet) == 2
    upstream.kill()


def test_websockets_need_the_cookie_and_the_right_origin(echo: tuple[Front, list[ServerConnection]]) -> None:
    front, opened = echo
    for options in ({"key": ""}, {"origin": "http://evil.example"}, {"path": "/drop"}):
        with pytest.raises(InvalidStatus):
            open_tab(front, **options)
    assert not opened


def test_a_killed_private_server_ends_websockets_and_is_reported(front: Front, upstream: Upstream) -> None:
    path, *headers = upgrade()
    lines = [f"GET {below(front, path)} HTTP/1.1", "Host: 127.0.0.1", f"Cookie: {cookie(front)}"]
    head = "\r\n".join([*lines, *headers])
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        client.sendall(head.encode() + b"\r\n\r\n")
        assert status(client.recv(65536)) == 101
        upstream.kill()
        assert client.recv(65536) == b""
    answer = get(front)
    assert status(answer) == 502
    assert answer.endswith(b"The viewer has ended.\n")


@pytest.mark.parametrize(
    "answer", [b"", b"nonsense\r\n\r\n", b"HTTP/1.1 200 OK\r\n", b"HTTP/1.1 101 Switching Protocols\r\n\r\n"]
)
def test_a_broken_response_is_reported(answer: bytes) -> None:
    upstream = Upstream(answer)
    with Front() as front:
        front.start(upstream.listener.getsockname())
        assert status(get(front)) == 502
    upstream.kill()


# addresses and ports


def test_only_this_machine_can_connect_by_default(front: Front) -> None:
    assert front.local
    assert front.address.startswith(f"http://127.0.0.1:{front.port}/?token=")
    for family, _, _, _, address in socket.getaddrinfo(socket.gethostname(), front.port, type=socket.SOCK_STREAM):
        if str(address[0]).startswith("127.") or address[0] == "::1":
            continue
        with socket.socket(family, socket.SOCK_STREAM) as client:
            client.settimeout(2)
            assert client.connect_ex(address) != 0


def test_both_loopback_addresses_are_taken(front: Front) -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6")
    try:
        connection = http.client.HTTPConnection("::1", front.port, timeout=5)
        connection.connect()
    except OSError:
        pytest.skip("no IPv6")
    connection.request("GET", below(front), headers={"Host": f"[::1]:{front.port}", "Cookie": cookie(front)})
    assert connection.getresponse().read() == b"robot"


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_other_machines_are_given_an_address_and_the_ssh_line(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine's name often does not resolve elsewhere."""
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    with Front(host=host) as front:
        assert not front.local
        shown = ipaddress.ip_address(urllib.parse.urlsplit(front.address).hostname or "")
        assert not shown.is_loopback
        assert not shown.is_unspecified
        assert "not encrypted" in front.instructions[1]
        assert front.ssh_line in front.instructions[2]
        assert f"http://127.0.0.1:{front.port}/?token={token(front)}" in front.instructions[3]
    monkeypatch.setenv("SSH_CONNECTION", "198.51.100.7 50000 203.0.113.9 22")
    with Front(host=host) as front:
        assert front.address.startswith(f"http://203.0.113.9:{front.port}/?token=")


def test_a_machine_without_a_network_shows_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    monkeypatch.setattr(module, "route_address", lambda family: None)
    with Front(host="0.0.0.0") as front:
        assert front.address.startswith(f"http://{socket.gethostname().lower()}:{front.port}/?token=")


def test_one_address_of_the_machine_is_forwarded_as_such() -> None:
    address = sockets_module.route_address(socket.AF_INET)
    if address is None:
        pytest.skip("no network")
    with Front(host=address) as front:
        assert front.address.startswith(f"http://{address}:{front.port}/?token=")
        assert f"-L {front.port}:{address}:{front.port} " in front.ssh_line


def test_a_free_port_is_found_unless_one_is_asked_for() -> None:
    with Front() as one, Front() as two:
        assert one.port != two.port
        with pytest.raises(ValueError, match=f"^port {one.port} is in use: choose another one"):
            Front(port=one.port)


def test_all_usual_ports_in_use_leave_any_free_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets_module, "PORTS", 1)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        monkeypatch.setattr(sockets_module, "FIRST_PORT", other.getsockname()[1])
        with Front() as front:
            assert front.port != other.getsockname()[1]


@pytest.mark.parametrize(
    ("host", "message"),
    [("192.0.2.1", "no such address"), ("no.such.host.invalid", "no address of that name is known")],
)
def test_an_address_that_is_not_available_is_one_line(host: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"^cannot listen on '{host}'.*{message}"):
        Front(host=host)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_out_of_range_is_named(port: int) -> None:
    with pytest.raises(ValueError, match=f"port {port} is out of range"):
        Front(port=port)


def test_close_ends_connections_and_frees_the_port(upstream: Upstream) -> None:
    front = Front()
    front.start(upstream.listener.getsockname())
    with socket.create_connection(("127.0.0.1", front.port), timeout=10) as client:
        client.sendall(b"GET /")
        wait_until(lambda: bool(get(front)))
        front.close()
        assert client.recv(1) == b""
    front.close()
    with Front(port=front.port) as again:
        assert again.port == front.port


def test_the_ssh_line_forwards_the_port(front: Front, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("getpass.getuser", lambda: "ada")
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    forward = f"ssh -C -N -L {front.port}:127.0.0.1:{front.port}"
    assert front.ssh_line == f"{forward} ada@{socket.gethostname()}"
    monkeypatch.setenv("SSH_CONNECTION", "198.51.100.7 50000 203.0.113.9 2222")
    assert front.ssh_line == f"{forward} -p 2222 ada@203.0.113.9"
    assert front.instructions == [f"viewer: {front.address}", f"from another machine: {front.ssh_line}"]


def test_the_browsers_command_line_does_not_contain_the_token(front: Front, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address, new: opened.append(address))
    front.open_in_browser()
    wait_until(lambda: bool(opened))
    assert token(front) not in opened[0]
    file = Path(opened[0].removeprefix("file://"))
    assert front.address in file.read_text()
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    front.close()
    assert not file.parent.exists()


# the private socket

CONNECT = """
import socket, sys
with socket.create_connection(("127.0.0.1", int(sys.argv[1])), timeout=10) as client:
    client.sendall(b"hello")
    try:
        print("closed" if client.recv(10) == b"" else "answered")
    except ConnectionError:
        print("closed")
"""


def test_other_processes_cannot_connect_to_a_private_socket() -> None:
    with private_socket() as private:
        process = subprocess.Popen(
            [sys.executable, "-c", CONNECT, str(private.getsockname()[1])], stdout=subprocess.PIPE
        )
        with pytest.raises(ConnectionAbortedError, match="another process"):
            private.accept()
        assert process.communicate(timeout=30)[0] == b"closed\n"
        with socket.create_connection(private.getsockname()) as own:
            connection, address = private.accept()
            with connection:
                assert address == own.getsockname()
