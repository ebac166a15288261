"""Serve studio's page below a secret path.

Studio's own server has no password, and all users of a machine can connect to its loopback address. The public port is
therefore opened here, and ``PageServer.serve`` replaces ``websockets.serve`` in studio's server: it answers only
requests whose path begins with the secret, which is a part of the printed address. Pages of other sites do not know the
secret, so neither forged requests nor DNS rebinding can reach studio.

Studio's page requests absolute paths, such as ``/ui``. The script ``page.js`` adds the secret in front of them.
"""

import asyncio
import contextlib
import errno
import getpass
import gzip
import hmac
import html
import ipaddress
import logging
import math
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

FIRST_PORT, PORTS = 8080, 20
"""By default, these ports are tried before any free port."""
RESPONSE_SECONDS = 300.0
"""Timeout in seconds for a request and its response. Models with many meshes have tens of megabytes."""
PING_SECONDS = 30.0
"""Seconds between pings, which detect a lost browser."""
MESSAGE_BYTES = 2**20
"""Maximum size of a WebSocket message from a browser, in bytes."""
FRAMES = 2
"""Number of frames after each input of a page. The first frame may not contain the effects of the input yet."""
QUIET_SECONDS = 5.0
"""A page without input for this many seconds counts as hidden. An open page sends input with every frame."""
SCRIPT = Path(__file__).with_name("page.js")

_HEADERS = {
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",  # browsers require this for SharedArrayBuffer
    "Document-Isolation-Policy": "isolate-and-require-corp",  # Chromium requires this in notebooks
}
_CONTROL_TAKEN = 4001  # studio's WebSocket close code
_GAMEPAD = "gamepad="  # begins a message of page.js


class Tab(ServerConnection):
    """A WebSocket that calls ``heard`` at each message, and ``driven`` instead of returning a gamepad's message."""

    heard: Callable[[], object] | None = None
    driven: Callable[[list[float]], object]

    async def recv(self, *arguments: Any, **options: Any) -> Any:
        """Receive a message."""
        while isinstance(message := await super().recv(*arguments, **options), str) and message.startswith(_GAMEPAD):
            with contextlib.suppress(ValueError):
                axes = [float(axis) for axis in message.removeprefix(_GAMEPAD).split(",")]
                if len(axes) == 3 and all(abs(axis) <= 1 for axis in axes):
                    self.driven(axes)
        if self.heard is not None:
            self.heard()
        return message


class PageServer:
    """Opens the port of the page, and answers requests with the secret.

    Args:
        host: The address on which the page is served.
        port: The port, by default the first free port from 8080.
        title: The title of the page.

    Raises:
        ValueError: The port is out of range or in use, or the address is not an address of this machine.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int | None = None, title: str = "lyceum_warp") -> None:
        self._sockets = public_sockets(host, port)
        self._secret = secrets.token_urlsafe(32)
        self._title = title
        self.on_look: Callable[[bool], object] = lambda looks: None
        """Called in the server's thread with True at each input of the page that has control, and with False after this
        page was closed or hidden."""
        self.on_gamepad: Callable[[list[float]], object] = lambda axes: None
        """Called in the server's thread with a gamepad's axes, from -1 to 1."""
        self.inputs = 0
        """The number of inputs of the page that has control: one for each picture that the page has drawn."""
        self._loop: asyncio.AbstractEventLoop
        self._tabs: set[ServerConnection] = set()
        self._files: dict[str, Path] = {}  # offered for download, by name
        self._silence: asyncio.TimerHandle | None = None
        self._frames_due = threading.Event()
        self._frames = 0.0  # number of frames that are due

    @property
    def instructions(self) -> list[str]:
        """The lines to print: the address, the ssh command, and a warning if other machines can connect."""
        name, port = self._sockets[0].getsockname()[:2]
        address = ipaddress.ip_address(name.partition("%")[0])
        host = "127.0.0.1" if address.is_unspecified else f"[{name}]" if address.version == 6 else name
        connection = os.environ.get("SSH_CONNECTION", "").split()  # address and port of the client and of this machine
        machine, ssh_port = connection[2:] or (socket.gethostname(), "22")
        target = machine
        with contextlib.suppress(KeyError, OSError):  # in some containers the user has no name
            target = f"{getpass.getuser()}@{machine}"
        if ssh_port != "22":
            target = f"-p {ssh_port} {target}"
        ssh = f"from another machine: ssh -C -N -L {port}:{host}:{port} {target}"
        path = f":{port}/{self._secret}/"
        if address.is_loopback:
            return [f"viewer: http://{host}{path}", ssh]
        return [
            f"viewer: http://{machine if address.is_unspecified else host}{path}",
            "warning: other machines can connect, and what they send is not encrypted",
            f"encrypted, {ssh}",
            f"and open there: http://127.0.0.1{path}",
        ]

    def offer(self, file: str) -> None:
        """Offer a file as a download on all open pages. Any thread may call this method."""
        path = Path(file)
        self._files[path.name] = path
        self.tell(f"saved={path.name}")

    def tell(self, message: str) -> None:
        """Send a message to the script of all open pages. Any thread may call this method."""
        self._loop.call_soon_threadsafe(broadcast, self._tabs, message)

    def take_frame(self, seconds: float) -> bool:
        """Wait at most ``seconds`` until the page that has control can show a frame, and return whether it can.

        While a page connects, frames are always due, because studio connects when it makes frames.
        """
        due = self._frames_due.wait(seconds)
        self._frames -= 1
        if self._frames <= 0:
            self._frames_due.clear()
        return due

    def _request(self, frames: float) -> None:
        self._frames = frames
        self._frames_due.set() if frames else self._frames_due.clear()

    def close(self) -> None:
        """Close the port."""
        for each in self._sockets:
            each.close()

    # within the server's thread

    def serve(self, handler: Any, *, process_request: Any, **options: Any) -> Any:
        """Serve as ``websockets.serve`` does, but at the public port, and only requests with the secret."""
        self._loop = asyncio.get_running_loop()

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            secret, _, path = request.path.removeprefix("/").partition("/")
            if not hmac.compare_digest(secret.encode(errors="replace"), self._secret.encode()):
                return _response(403, "Open the address that was printed where the viewer was started.\n")
            request.path = f"/{path}"
            return self._own_response(path) or process_request(connection, request)

        async def handle(tab: Tab) -> None:
            assert tab.request is not None
            if tab.request.path.startswith("/ui"):
                tab.heard = lambda: self._hear(tab)
                self._request(math.inf)
            else:
                self._tabs.add(tab)
                tab.driven = self.on_gamepad
            try:
                await handler(tab)
            finally:
                self._tabs.discard(tab)
                if tab.heard is not None:
                    self._request(0)
                    self.on_look(False)

        options |= {
            "sock": self._sockets[0], "create_connection": Tab, "process_request": answer,
            "process_response": self._completed, "max_size": MESSAGE_BYTES, "open_timeout": RESPONSE_SECONDS,
            "close_timeout": RESPONSE_SECONDS, "ping_interval": PING_SECONDS, "ping_timeout": PING_SECONDS,
            "logger": logging.Logger("viewer", logging.CRITICAL),  # do not log malformed requests
            "compression": "deflate",  # windows with changed numbers shrink to a sixth
        }  # fmt: skip
        return serve(handle, **options)  # type: ignore[arg-type]  # every connection is a Tab

    def _own_response(self, path: str) -> Response | None:
        """Respond to a request that studio does not know, or that would load another model."""
        folder, _, name = path.partition("/")
        if path == SCRIPT.name:
            return _response(200, SCRIPT.read_bytes(), "text/javascript")
        if folder == "saved" and name in self._files:
            return _response(200, self._files[name].read_bytes(), "application/octet-stream")
        return _response(404, "the viewer shows one model only\n") if path.startswith("drop") else None

    async def _completed(self, connection: ServerConnection, request: Request, response: Response) -> Response:
        """Add the script to studio's page, headers for isolation, and compress the body."""
        headers = response.headers
        for name, value in _HEADERS.items():
            headers.pop(name, None)
            headers[name] = value
        if headers.get("Content-Type", "").startswith("text/html"):
            title = f"<title>{html.escape(self._title)}</title>"
            page = re.sub("<title>.*?</title>", lambda _: title, response.body.decode(), count=1)
            response.body = page.replace("<head>", f'<head><script src="{SCRIPT.name}"></script>', 1).encode()
        if response.body:
            if "gzip" in request.headers.get("Accept-Encoding", ""):
                response.body = await asyncio.to_thread(gzip.compress, response.body, 1)
                headers["Content-Encoding"] = "gzip"
            headers.pop("Content-Length", None)
            headers["Content-Length"] = str(len(response.body))
        return response

    def _hear(self, tab: ServerConnection) -> None:
        self.inputs += 1
        self.on_look(True)
        self._request(FRAMES)
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self._loop.call_later(QUIET_SECONDS, self._end_control, tab)

    def _end_control(self, tab: ServerConnection) -> None:
        """Give control to another tab, because frames are made only for the tab that has control."""
        self.on_look(False)
        if len(self._tabs) > 1:
            self._end = self._loop.create_task(tab.close(_CONTROL_TAKEN, "hidden"))


def _response(status: int, body: str | bytes, kind: str = "text/plain") -> Response:
    content = body.encode() if isinstance(body, str) else body
    return Response(status, "", Headers({"Content-Type": kind}), content)


# sockets


def public_sockets(host: str, port: int | None) -> list[socket.socket]:
    """Listen on an address. The first socket listens; see ``_listen`` for the second one.

    Raises:
        ValueError: The port is out of range or in use, or the address is not an address of this machine.
    """
    candidates = [*range(FIRST_PORT, FIRST_PORT + PORTS), 0] if port is None else [port]
    for candidate in candidates:
        try:
            return _listen(host, candidate)
        except (OSError, OverflowError) as error:
            if candidate == candidates[-1]:
                reason = f"cannot listen on {host!r}, port {candidate}: {error}; choose another host or port"
                raise ValueError(reason) from error
    raise AssertionError


def _listen(host: str, port: int) -> list[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    server = socket.create_server((host, port), family=family, dualstack_ipv6=host == "::")
    address, port = server.getsockname()[:2]
    if address != "127.0.0.1":
        return [server]
    # reserve the other loopback address, where another user could pose as the viewer at localhost
    other = socket.socket(socket.AF_INET6)
    try:
        other.bind(("::1", port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            server.close()
            other.close()
            raise
    return [server, other]


class PrivateSocket(socket.socket):
    """A socket for a free port of 127.0.0.1 that refuses connections of other users.

    All users of a machine can connect to its loopback address. Studio calls ``listen``. Its user interface would poll
    an earlier connection, which no page needs yet.
    """

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self.bind(("127.0.0.1", 0))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection of this user."""
        connection, address = super().accept()
        if _user_of(address[1], self.getsockname()[1]) != os.getuid():
            connection.close()
            raise ConnectionAbortedError("another user tried to connect")  # event loops ignore this type of error
        return connection, address


def _user_of(port: int, peer_port: int) -> int | None:
    """Return the id of the user who owns the loopback connection from ``port`` to ``peer_port``."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local, remote, _, _, _, _, user, *_ = line.split()
        if (local[-4:], remote[-4:]) == (f"{port:04X}", f"{peer_port:04X}"):
            return int(user)
    return None
