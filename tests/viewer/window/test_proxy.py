import contextlib
import http.client
import http.cookiejar
import os
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from lyceum_warp.viewer.window import proxy as module, sockets as sockets_module
from lyceum_warp.viewer.window.proxy import Proxy
from lyceum_warp.viewer.window.sockets import private_socket

UPGRADE = (
    "Upgrade: websocket", "Connection: keep-alive, Upgrade", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version: 13",
)  # fmt: skip


class Upstream:
    """A private server that stores all received bytes."""

    def __init__(self, answer: bytes | None = None) -> None:
        headers = b"Access-Control-Allow-Origin: *\r\nSet-Cookie: a=b\r\nCache-Control: no-cache\r\nConnection: close"
        self.answer = answer or b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n" + headers + b"\r\n\r\nrobot"
        self.received: list[bytes] = []
        self.ended = 0
        self.listener = private_socket()
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                threading.Thread(target=self.serve, args=(connection,), daemon=True).start()

    def serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            self.received.append(connection.recv(65536))
            connection.sendall(self.answer)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                pass
        self.ended += 1


@contextlib.contextmanager
def proxy_of(upstream: Upstream) -> Iterator[Proxy]:
    with Proxy() as opened:
        opened.start(upstream.listener.getsockname())
        yield opened
    upstream.listener.close()


@pytest.fixture
def upstream() -> Upstream:
    return Upstream()


@pytest.fixture
def proxy(upstream: Upstream) -> Iterator[Proxy]:
    with proxy_of(upstream) as opened:
        yield opened


def token(proxy: Proxy) -> str:
    return proxy.address.partition("token=")[2]


def answer_to(proxy: Proxy, lines: list[str], *, rest: bytes = b"") -> bytes:
    with socket.create_connection(("127.0.0.1", proxy.port), timeout=10) as client:
        if not any("Connection: " in line for line in lines):
            lines = [*lines, "Connection: close"]
        client.sendall("\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + rest)
        answer = b""
        while data := client.recv(65536):
            answer += data
        return answer


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


def entered(proxy: Proxy) -> tuple[str, str]:
    answer = answer_to(proxy, [f"GET /?token={token(proxy)} HTTP/1.1", "Host: 127.0.0.1"]).decode()
    found = re.search(r"\r\nSet-Cookie: ([^;]*); Path=(/[^;]*)/;", answer)
    assert found is not None
    return found[1], found[2]


def get(
    proxy: Proxy, path: str = "/PATH/", *headers: str, host: str = "HOST", cookie: str = "lyceum-warp=VALUE",
    method: str = "GET", rest: bytes = b"",
) -> bytes:  # fmt: skip
    """Return the response to a request.

    In arguments, PORT, PATH, VALUE and TOKEN stand for the proxy's port, path, cookie and token.
    """
    own, below = entered(proxy)
    words = {"HOST": "127.0.0.1:PORT", "PORT": str(proxy.port), "PATH": below.strip("/"), "TOKEN": token(proxy),
             "VALUE": own.partition("=")[2]}  # fmt: skip
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", f"Cookie: {cookie}", *headers]
    for word, meaning in words.items():
        lines = [line.replace(word, meaning) for line in lines]
    return answer_to(proxy, lines, rest=rest)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# the secret


def test_token_is_exchanged_for_a_cookie_and_removed_from_the_address(proxy: Proxy, upstream: Upstream) -> None:
    answer = get(proxy, "/?token=TOKEN", host="localhost:PORT", cookie="").decode()
    assert answer.startswith("HTTP/1.1 303 ") and len(token(proxy)) == 43  # 32 bytes
    target = re.search(r"\r\nLocation: (/[\w-]{43}/)\r\n", answer)
    given = re.search(r"\r\nSet-Cookie: lyceum-warp=([\w-]{43})(.*)\r\n", answer)
    assert target is not None and given is not None
    assert given[2] == f"; Path={target[1]}; HttpOnly; SameSite=Strict"
    assert token(proxy) not in answer and given[1] not in target[1]
    assert not upstream.received
    with Proxy() as other:
        assert token(other) != token(proxy)
        other.start(("127.0.0.1", 1))
        foreign = entered(other)[0]
    assert status(get(proxy, cookie=foreign)) == 403
    assert get(proxy, cookie=f"{foreign}; bad[{{; theme=dark; lyceum-warp=VALUE; lyceum-warp=x").endswith(b"robot")


class Jar(http.cookiejar.CookieJar):
    """Send a host's cookies to all its ports, as browsers do."""

    def sent_to(self, address: str) -> str | None:
        asked = urllib.request.Request(address)
        self.add_cookie_header(asked)
        return asked.get_header("Cookie")


def test_browser_does_not_send_the_cookie_to_another_port(proxy: Proxy) -> None:
    jar = Jar()
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
    cookie, path = entered(proxy)
    with browser.open(proxy.address) as page:
        assert page.read() == b"robot"
        assert jar.sent_to(f"http://127.0.0.1:{proxy.port}{path}/") == cookie
    for other in ("/", "/ui", "/state", "/model", "/lyceum-warp/", "/index.html"):
        assert jar.sent_to(f"http://127.0.0.1:{proxy.port + 1}{other}") is None


# none of these attacks may reach the private server

ORIGINS = ("http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1", "file://",
           "http://localhost:PORT", "http://127.0.0.1:PORT.evil.example", "http://127.0.0.1:PORT/", "")  # fmt: skip
EMBEDDED = (("cross-site", "no-cors", "script"), ("same-site", "no-cors", "image"),
            ("cross-site", "navigate", "iframe"), ("cross-site", "websocket", "websocket"))  # fmt: skip
FOREIGN = [
    *[(f"Origin: {origin}",) for origin in ORIGINS],
    *[(f"Sec-Fetch-Site: {a}", f"Sec-Fetch-Mode: {b}", f"Sec-Fetch-Dest: {c}") for a, b, c in EMBEDDED],
]
HOSTS = ("evil.example", "evil.example:PORT", "127.0.0.1.evil.example", "localhost.evil.example:PORT", "localhost.")
COOKIES = ("", "lyceum-warp=", "lyceum-warp=wrong", "lyceum-warp=TOKEN", "x=VALUE", "lyceum-warp=VALUEx",
           "lyceum-warp=PATH", "lyceum-warp=VALUE\xe9")  # fmt: skip
TOKENS = ("/?token=", "/?token=WRONG", "/?token=TOKEN&token=WRONG", "/?token=TOKEN&token=TOKEN", "/model?token=WRONG",
          "/model?token=TOKEN", "/?token=token\xe9")  # fmt: skip
PLACES = ("/", "/index.html", "//", "/WRONG/", "/PATH", "/PATHx/", "//PATH/", "/x/../PATH/", "/VALUE/", "/model",
          "/?tokenx=TOKEN")  # fmt: skip
SPELLINGS = ("//drop", "/./drop", "/x/../drop", "/%64rop", "/drop%20", "/..", "/assets/../../x", "/\\drop")
UPGRADES = [
    (*(line for line in UPGRADE if line.partition(":")[0] != header.partition(":")[0]), header)
    for header in ("Upgrade: h2c", "Sec-WebSocket-Key: short", "Sec-WebSocket-Key: ", "Connection: close",
                   "Sec-WebSocket-Version: 6")
]  # fmt: skip
LARGE = ("X: " + "a" * 20_000, "\r\n".join(f"X-{n}: {n}" for n in range(3000)), "Cookie: " + "a=b; " * 5000)
BODIES = ("Content-Length: 44", "Transfer-Encoding: chunked", "Content-Length: 0\r\nTransfer-Encoding: chunked")
LINK = ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: document")
ATTACKS: list[tuple[set[int], str, tuple[str, ...], dict[str, str]]] = [
    *[({400, 403}, path, (), {}) for path in TOKENS],
    *[({403}, path, (), {}) for path in PLACES],
    *[({403}, "/PATH/", headers, {"cookie": cookie}) for cookie in COOKIES for headers in ((), LINK)],
    *[({403}, "/PATH/ui", UPGRADE, {"cookie": cookie}) for cookie in COOKIES],
    *[({403}, path, headers, {}) for headers in FOREIGN for path in ("/PATH/model", "/?token=TOKEN")],
    *[({403}, "/PATH/state", (*headers, *UPGRADE), {}) for headers in FOREIGN],
    ({403}, "/PATH/", ("Origin: http://127.0.0.1:PORT", "Origin: http://evil.example"), {}),
    *[({421}, path, (), {"host": host}) for host in HOSTS for path in ("/PATH/", "/?token=TOKEN")],
    *[({400}, "/PATH/", (), {"host": host}) for host in ("a@HOST", "HOST/", "HOST\r\nHost: HOST", " ")],
    *[({400, 404}, f"/PATH{path}", headers, {}) for path in SPELLINGS for headers in ((), UPGRADE)],
    *[({404}, f"/PATH/{path}", UPGRADE, {}) for path in ("", "model", "upload", "drop", "drop?sid=1", "ui/")],
    *[({400}, "/PATH/ui", headers, {}) for headers in UPGRADES],
    *[({400, 431}, "/PATH/", (header,), {}) for header in LARGE],
    *[({405}, "/PATH/", (), {"method": method}) for method in ("POST", "PUT", "DELETE", "HEAD", "OPTIONS", "TRACE")],
    *[({400}, "/PATH/", (header,), {}) for header in BODIES],
]  # fmt: skip


@pytest.mark.parametrize(("codes", "path", "headers", "options"), ATTACKS)
def test_proxy_rejects_an_attack(
    proxy: Proxy, upstream: Upstream, codes: set[int], path: str, headers: tuple[str, ...], options: dict[str, str]
) -> None:
    smuggled = b"0\r\n\r\nGET /drop HTTP/1.1\r\n\r\n" if headers and headers[0] in BODIES else b""
    answer = get(proxy, path, *headers, rest=smuggled, **options)  # type: ignore[arg-type]
    assert status(answer) in codes and len(re.findall(rb"HTTP/1\.[01] \d", answer)) == 1
    assert not upstream.received


# Studio's responses


def test_other_sites_cannot_read_or_embed_the_page(proxy: Proxy) -> None:
    for answer in (get(proxy, "/PATH/model"), get(proxy, cookie=""), get(proxy, host="x")):
        head = answer.partition(b"\r\n\r\n")[0].decode().lower()
        for line in ("content-security-policy: frame-ancestors http://localhost:* http://127.0.0.1:*\r\n",
                     "cross-origin-resource-policy: same-origin", "referrer-policy: no-referrer"):  # fmt: skip
            assert head.count(f"\r\n{line}") == 1
        assert "access-control-" not in head and "set-cookie" not in head
    assert b"\r\nCache-Control: no-cache\r\n" in get(proxy, "/PATH/model")


def test_page_of_this_host_can_embed_the_viewer_if_it_knows_the_token(proxy: Proxy, upstream: Upstream) -> None:
    frame = ("Sec-Fetch-Site: same-site", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: iframe")
    assert re.search(rb'<meta http-equiv="refresh" content="0; url=/[\w-]{43}/">', get(proxy, "/?token=TOKEN", *frame))
    assert status(get(proxy, "/?token=WRONG", *frame)) == status(get(proxy, "/PATH/", *frame, cookie="")) == 403
    assert not upstream.received


@pytest.mark.parametrize("answer", [
    b"nonsense\r\n\r\n", b"HTTP/1.1 200 OK\r\n",
    b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 26\r\n\r\n<title>robot</title>      ", None,
])  # fmt: skip
def test_invalid_or_missing_response_gives_status_502(answer: bytes | None) -> None:
    upstream = Upstream(answer)
    if answer is None:
        upstream.listener.shutdown(socket.SHUT_RDWR)
    with proxy_of(upstream) as proxy:
        assert status(get(proxy)) == 502


# requests


def test_following_a_token_link_from_another_site_opens_the_viewer(proxy: Proxy, upstream: Upstream) -> None:
    answer = get(proxy, "/?token=TOKEN", *LINK, cookie="").decode()
    assert answer.startswith("HTTP/1.1 200 ") and "Set-Cookie: " in answer and not upstream.received
    assert f'content="0; url={entered(proxy)[1]}/"' in answer


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.0.0.1:9000", "localhost:9000", "Localhost:80", "[::1]:9000", "192.168.0.7:8080"]
)
def test_addresses_of_this_machine_are_accepted_at_any_port(proxy: Proxy, host: str) -> None:
    """A forwarded port may differ from the proxy's own port."""
    assert status(get(proxy, "/PATH/", f"Origin: http://{host.lower()}", host=host)) == 200


def test_requests_are_forwarded_without_the_headers_of_the_client(proxy: Proxy, upstream: Upstream) -> None:
    for path in ("/index.html", "/model?crc32=1&total_bytes", "/assets/AtkinsonHyperlegibleNext[wght].ttf"):
        upstream.received.clear()
        assert get(proxy, f"/PATH{path}", "X-Forwarded-For: 1").endswith(b"\r\n\r\nrobot")
        (received,) = upstream.received
        assert received.startswith(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:".encode())
        assert b"Cookie" not in received and b"X-Forwarded-For" not in received


def test_only_offered_files_are_sent_and_only_with_the_cookie(proxy: Proxy, tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"offered")
    (tmp_path / "secret.txt").write_bytes(b"not offered")
    proxy.offer(str(tmp_path / "video.mp4"))
    answer = get(proxy, "/PATH/saved/video.mp4")
    assert status(answer) == 200 and answer.endswith(b"\r\n\r\noffered")
    assert b"Content-Disposition: attachment" in answer and b"nosniff" in answer
    assert status(get(proxy, "/PATH/saved/video.mp4", cookie="")) == status(get(proxy, "/saved/video.mp4")) == 403
    for name in ("secret.txt", "../secret.txt", "%2e%2e/secret.txt", "video.mp4/../secret.txt", str(tmp_path)):
        assert status(get(proxy, f"/PATH/saved/{name}")) == 404


def test_endless_request_head_is_rejected_without_being_buffered(proxy: Proxy) -> None:
    with socket.create_connection(("127.0.0.1", proxy.port), timeout=10) as client:
        sent = 0
        with contextlib.suppress(OSError):
            while sent < 64 * 2**20:
                sent += client.send(b"a" * 2**16)
        assert sent < 64 * 2**20


def test_second_request_on_a_connection_is_also_checked(proxy: Proxy, upstream: Upstream) -> None:
    second = b"GET /model HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    answer = get(proxy, "/PATH/", "Connection: keep-alive", rest=second)
    assert [int(code) for code in re.findall(rb"HTTP/1.1 (\d+)", answer)] == [200, 403]
    assert len(upstream.received) == 1


# slow clients


def test_slow_request_head_closes_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HEAD_SECONDS", 0.3)
    with (
        proxy_of(Upstream()) as proxy,
        socket.create_connection(("127.0.0.1", proxy.port), timeout=10) as client,
        pytest.raises(ConnectionError),
    ):
        for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + 600 * b"a":
            client.send(bytes([byte]))
            time.sleep(0.02)


def test_silent_connections_do_not_block_other_connections(proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "UNCHECKED", 8)
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", proxy.port))) for _ in range(40)]
        assert status(get(proxy)) == 200
        silent[0].settimeout(5)
        assert silent[0].recv(1) == b""


def test_connection_is_closed_if_the_client_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WRITE_SECONDS", 0.3)
    size = 64 * 2**20
    upstream = Upstream(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % size + bytes(size))
    with proxy_of(upstream) as proxy:
        key, path = entered(proxy)
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.connect(("127.0.0.1", proxy.port))
            client.sendall(f"GET {path}/ HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {key}\r\n\r\n".encode())
            wait_until(lambda: upstream.ended == 1)
            with pytest.raises(ConnectionError):  # the connection is closed
                for _ in range(1000):
                    client.send(b"x")
                    time.sleep(0.01)


# WebSockets


@pytest.fixture
def echo() -> Iterator[tuple[Proxy, list[ServerConnection], list[float]]]:
    """Run a proxy of a WebSocket server.

    Yield the proxy, its connections, and the times at which silence was reported.
    """
    opened: list[ServerConnection] = []
    quiet: list[float] = []

    def handle(connection: ServerConnection) -> None:
        opened.append(connection)
        with contextlib.suppress(ConnectionClosed):
            for message in connection:
                if message == "close":
                    connection.close(4001, "control taken")
                connection.send(message)
        opened.remove(connection)

    private = private_socket()
    with serve(handle, sock=private, compression=None, max_size=None) as server, Proxy() as proxy:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        proxy.start(private.getsockname(), on_quiet=lambda: quiet.append(time.monotonic()))
        yield proxy, opened, quiet


Echo = tuple[Proxy, list[ServerConnection], list[float]]


def open_tab(proxy: Proxy, path: str = "/ui") -> ClientConnection:
    cookie, before = entered(proxy)
    host = f"127.0.0.1:{proxy.port}"
    return connect(f"ws://{host}{before}{path}", origin=f"http://{host}", max_size=None,  # type: ignore[arg-type]
                   additional_headers={"Cookie": cookie})  # fmt: skip


def test_proxy_serves_two_tabs_and_notices_a_closed_or_lost_tab(echo: Echo) -> None:
    proxy, opened, _ = echo
    with open_tab(proxy) as one:
        with open_tab(proxy, "/state?sid=b") as two:
            large = os.urandom(2**20 - 100)
            one.send(large)
            two.send("two")
            assert two.recv() == "two"
            assert one.recv() == large
        wait_until(lambda: len(opened) == 1)
        one.send(b"still here")
        assert one.recv() == b"still here"
        one.socket.shutdown(socket.SHUT_RDWR)  # a killed browser closes its connection in the same way
        wait_until(lambda: not opened)


def test_page_receives_the_reason_for_a_closed_websocket(echo: Echo) -> None:
    with open_tab(echo[0]) as tab:
        tab.send("close")
        with pytest.raises(ConnectionClosed, match="4001.*control taken"):
            tab.recv(timeout=10)
    with open_tab(echo[0]) as tab, pytest.raises(ConnectionClosed):
        tab.send(bytes(2**20 + 1))  # too large
        tab.recv(timeout=10)
    wait_until(lambda: not echo[1])


def test_silence_of_the_controlling_browser_is_reported(monkeypatch: pytest.MonkeyPatch, echo: Echo) -> None:
    monkeypatch.setattr(module, "QUIET_SECONDS", 0.5)
    proxy, _, quiet = echo
    with open_tab(proxy) as tab:
        tab.send(b"input")
        wait_until(lambda: len(quiet) == 1)  # a hidden tab sends nothing
        tab.send(b"input")
    wait_until(lambda: len(quiet) == 2)  # closed
    time.sleep(1.0)
    assert len(quiet) == 2


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
        with Proxy(host=host) as proxy:
            line = f"ssh -C -N -L {proxy.port}:127.0.0.1:{proxy.port} {target}"
            first, *others = proxy.instructions
            assert first == f"viewer: http://{address}:{proxy.port}/?token={token(proxy)}"
            if host == "127.0.0.1":
                assert others == [f"from another machine: {line}"]
            else:
                assert "not encrypted" in others[0] and line in others[1]
                assert f"http://127.0.0.1:{proxy.port}/?token={token(proxy)}" in others[2]


def test_free_port_is_found_and_busy_port_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets_module, "PORTS", 1)
    with Proxy() as one, Proxy() as other:
        assert one.port != other.port
        with pytest.raises(ValueError, match=f"^port {one.port} is in use: choose another one"):
            Proxy(port=one.port)
        monkeypatch.setattr(sockets_module, "FIRST_PORT", one.port)
        with Proxy() as third:  # all usual ports are in use
            assert third.port != one.port
    for port in (-1, 65536):
        with pytest.raises(ValueError, match=f"port {port} is out of range"):
            Proxy(port=port)
    for host, message in (("192.0.2.1", "no such address"), ("no.such.host.invalid", "no address of that name is")):
        with pytest.raises(ValueError, match=f"^cannot listen on '{host}'.*{message}"):
            Proxy(host=host)


def test_close_ends_connections_and_frees_the_port(proxy: Proxy) -> None:
    with socket.create_connection(("127.0.0.1", proxy.port), timeout=10) as client:
        client.sendall(b"GET /")
        assert get(proxy)
        proxy.close()
        assert client.recv(1) == b""
        proxy.close()
        with Proxy(port=proxy.port) as again:
            assert again.port == proxy.port


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
        command = [sys.executable, "-c", CONNECT, str(private.getsockname()[1])]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            with pytest.raises(ConnectionAbortedError, match="another process"):
                private.accept()
            assert process.communicate(timeout=30)[0] == b"closed\n"
        with socket.create_connection(private.getsockname()) as own:
            connection, address = private.accept()
            with connection:
                assert address == own.getsockname()
