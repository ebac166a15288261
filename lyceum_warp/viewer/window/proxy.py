"""The server that browsers talk to: it checks every request and passes it on to the viewer's own server.

The viewer's own server has no password. It listens on a private socket (`private_socket`), which refuses connections
of other processes, and the front (`Front`) stands before it. The front listens on the loopback address unless asked
otherwise and passes on a request only if all of these hold:

- The request is well-formed, without a body, complete within ten seconds, and its head has at most 16 KiB.
- Its ``Host`` is an address or a name of this machine, so that a foreign name that resolves to this machine
  (DNS rebinding) leads nowhere.
- Its ``Origin``, which browsers send with every WebSocket, is the front itself, and no other site's page asked for it.
- It carries the secrets of this viewer: once a token in the address that is printed, afterwards a cookie and the path
  of the page.
- It does not load another model.

Browsers send a cookie to every port of its host, and so to servers of other users on the same loopback address. The
cookie is therefore limited to a path that only the viewer and its browsers know (``Path=/RANDOM/``): a server that does
not know the path is not sent the cookie. The front serves everything below that path, and removes the path from
requests that it passes on. The page that the private server gives asks for some addresses from the root of the host; a
script that the front adds to the page puts the path in front of them.

Every connection carries one request. The front writes the request that it passes on from the parts that it checked,
and passes on bytes of the client only once a WebSocket is open. So both servers always agree where a request ends.
"""

import asyncio
import contextlib
import dataclasses
import getpass
import ipaddress
import os
import secrets
import socket
import tempfile
import threading
import time
import urllib.parse
import webbrowser
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from lyceum_warp.viewer.window.requests import (
    HOST,
    PROTECTION,
    STATUS,
    Refusal,
    Request,
    check_origin,
    check_target,
    enter,
    is_page,
    leading_to,
    parse,
    request_head,
    response_head,
    same,
    with_script,
)
from lyceum_warp.viewer.window.sockets import public_sockets, route_address

HEAD_BYTES = 16 * 1024
"""Largest head of a request."""
HEAD_SECONDS = 10.0
"""Time in which the head of a request must arrive."""
WRITE_SECONDS = 60.0
"""Time in which a client must take some bytes of a response."""
UNCHECKED = 128
"""Connections that have not shown the secret yet; beyond that the oldest one is closed."""
QUIET_SECONDS = 2.0
"""Time without input after which the browser that controls the viewer counts as gone.

A page sends input for every frame that it draws; a page that is closed, hidden or cut off does not.
"""
PAGE_BYTES = 2**20
"""Largest page that the script is added to."""

_CHUNK = 64 * 1024


class Front:
    """A server that passes requests with the right secret on to a private server of this process.

    Construction opens the port, `start` begins to answer, and `close` ends it. A front is also a context manager, which
    closes it.

    Args:
        host: Address or name to listen on. The default is the loopback address, which other machines cannot reach.
            Traffic is not encrypted, so forward the port by ssh rather than listen on another address.
        port: Port to listen on. By default the first free one from 8080 on.

    Raises:
        ValueError: The port is out of range or in use, or the address is not one of this machine.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int | None = None) -> None:
        try:
            self._sockets = public_sockets(host, port)
        except OSError as error:
            raise ValueError(error.strerror) from None
        addresses = [ipaddress.ip_address(each.getsockname()[0].partition("%")[0]) for each in self._sockets]
        self.port: int = self._sockets[0].getsockname()[1]
        """The port that browsers connect to."""
        self.local = all(address.is_loopback for address in addresses)
        """Whether only this machine can connect."""
        self._token, self._cookie, self._path = (secrets.token_urlsafe(32) for _ in range(3))
        machine = socket.gethostname().lower()
        self._names = {"localhost", machine, machine.partition(".")[0], host.lower()}
        self._everywhere = any(address.is_unspecified for address in addresses)
        self._host = "127.0.0.1" if self.local or self._everywhere else host
        families = {each.family for each in self._sockets}
        self._shown_host = _reachable_address(families) or machine if self._everywhere else self._host
        self._unchecked: dict[asyncio.Task[Any], None] = {}
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._upstream = ("", 0)
        self._on_quiet: Callable[[], None] | None = None
        self._heard: float | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @property
    def address(self) -> str:
        """The address to open in a browser, with the token."""
        return self._address(self._shown_host)

    @property
    def ssh_line(self) -> str:
        """The command that forwards the port, with compression, to the machine on which a person sits.

        In a session of ssh it names the address by which that session reached this machine.
        """
        connection = os.environ.get("SSH_CONNECTION", "").split()
        host, ssh_port = (connection[2], connection[3]) if len(connection) == 4 else (socket.gethostname(), "22")
        target = f"-p {ssh_port} " if ssh_port != "22" else ""
        try:
            target += f"{getpass.getuser()}@{host}"
        except (KeyError, OSError):  # a user without a name, as in some containers
            target += host
        return f"ssh -C -N -L {self.port}:{_in_address(self._host)}:{self.port} {target}"

    @property
    def instructions(self) -> list[str]:
        """Lines to print: the address, the command for ssh, and a warning if other machines can connect."""
        if self.local:
            return [f"viewer: {self.address}", f"from another machine: {self.ssh_line}"]
        return [
            f"viewer: {self.address}",
            "warning: other machines can connect, and what they send is not encrypted",
            f"encrypted, from another machine: {self.ssh_line}",
            f"and open there: {self._address('127.0.0.1')}",
        ]

    def _address(self, host: str) -> str:
        return f"http://{_in_address(host)}:{self.port}/?token={self._token}"

    def open_in_browser(self) -> None:
        """Open the page in this machine's browser, from a private file that leads to the address.

        Other users can see the command lines of all processes, so the browser's must not contain the token.
        """
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="lyceum-warp-", ignore_cleanup_errors=True)
        file = Path(self._folder.name) / "viewer.html"  # a folder of tempfile is for its user only
        file.write_text(leading_to(self.address))
        threading.Thread(target=webbrowser.open, args=(file.as_uri(),), kwargs={"new": 2}, daemon=True).start()

    def start(self, upstream: tuple[str, int], on_quiet: Callable[[], None] | None = None) -> None:
        """Begin to answer, in a thread.

        Args:
            upstream: Host and port of the private server.
            on_quiet: Called in that thread when the browser that controls the viewer has sent nothing for a while, as
                after its page was closed.
        """
        if self._thread is not None:
            raise RuntimeError("the front runs already")
        self._upstream, self._on_quiet = upstream, on_quiet
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(ready)), name="viewer-front", daemon=True)
        self._thread.start()
        ready.wait()

    def close(self) -> None:
        """Close the port and all connections. Later calls do nothing."""
        if self._thread is not None and self._loop is not None and self._stop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(timeout=5.0)
        for opened in self._sockets:
            opened.close()
        if self._folder is not None:
            self._folder.cleanup()

    def __enter__(self) -> "Front":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # within the thread

    async def _run(self, ready: threading.Event) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            servers = [await asyncio.start_server(self._serve, sock=each, limit=HEAD_BYTES) for each in self._sockets]
        finally:
            ready.set()
        watch = asyncio.create_task(self._watch_input())
        await self._stop.wait()
        watch.cancel()
        for server in servers:
            server.close()
        # asyncio.run cancels what is left

    async def _watch_input(self) -> None:
        while True:
            await asyncio.sleep(QUIET_SECONDS / 8)
            if self._heard is not None and time.monotonic() - self._heard > QUIET_SECONDS:
                self._heard = None
                if self._on_quiet is not None:
                    self._on_quiet()

    def _hear(self) -> None:
        self._heard = time.monotonic()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, which carries one request."""
        task = asyncio.current_task()
        assert task is not None
        if len(self._unchecked) >= UNCHECKED:
            next(iter(self._unchecked)).cancel()
        self._unchecked[task] = None
        try:
            try:
                request = await self._checked_request(reader)
                self._unchecked.pop(task)
                await self._pass_on(request, reader, writer)
            except Refusal as refusal:
                await _answer(writer, refusal)
                await _linger(reader, writer)
        except (OSError, EOFError, TimeoutError, asyncio.CancelledError):
            pass  # one of the two ends is gone, or the front ends
        finally:
            self._unchecked.pop(task, None)
            writer.close()

    async def _checked_request(self, reader: asyncio.StreamReader) -> Request:
        try:
            async with asyncio.timeout(HEAD_SECONDS):
                head = await reader.readuntil(b"\r\n\r\n")
        except TimeoutError:
            raise Refusal("408 Request Timeout", "the request took too long") from None
        except asyncio.LimitOverrunError:
            raise Refusal("431 Request Header Fields Too Large", "the request's head is too large") from None
        request = parse(head[:-4])
        self._check_host(request)
        check_origin(request)
        request = self._below_path(request)
        check_target(request)
        return request

    def _check_host(self, request: Request) -> None:
        """Refuse names that are not this machine's."""
        match = HOST.fullmatch(request.headers.get("host", "").lower())
        if match is None:
            raise Refusal("400 Bad Request", "the Host header is missing or malformed")
        name = match[1].strip("[]")
        try:
            ipaddress.ip_address(name)  # a page that a browser got from a bare address cannot be rebound
        except ValueError:
            if name not in self._names:
                text = f"{name} is not a name of this machine; use its address instead"
                raise Refusal("421 Misdirected Request", text) from None

    def _below_path(self, request: Request) -> Request:
        """Compare the token, or the path and the cookie; gives the request as the private server knows it.

        A token is answered with the cookie and the path.
        """
        path, question, query = request.target.partition("?")
        parameters = urllib.parse.parse_qsl(query, keep_blank_values=True)
        tokens = [value for name, value in parameters if name == "token"]
        if tokens:
            if not same(tokens[0], self._token) or len(tokens) > 1:
                raise Refusal("403 Forbidden", "This token is not the one of this viewer. " + _WHERE)
            if request.method != "GET" or request.websocket or path != "/":
                raise Refusal("400 Bad Request", "a token belongs to the first page")
            rest = urllib.parse.urlencode([(name, value) for name, value in parameters if name != "token"])
            target = f"/{self._path}/" + ("?" + rest if rest else "")
            raise enter(request, target, f"{_COOKIE}={self._cookie}; Path=/{self._path}/")
        first, slash, below = path.removeprefix("/").partition("/")
        pairs = [part.strip().partition("=") for part in request.headers.get("cookie", "").split(";")]
        known = any([same(value, self._cookie) for name, _, value in pairs if name == _COOKIE])
        if not same(first, self._path) or not slash or not known:
            raise Refusal("403 Forbidden", _WHERE)
        return dataclasses.replace(request, target=f"/{below}{question}{query}")

    async def _pass_on(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send a checked request to the private server, and its response to the client."""
        try:
            behind, ahead = await asyncio.open_connection(*self._upstream, limit=HEAD_BYTES)
        except OSError:
            raise Refusal("502 Bad Gateway", _ENDED) from None
        try:
            ahead.write(request_head(request))
            try:
                async with asyncio.timeout(WRITE_SECONDS):
                    head = await behind.readuntil(b"\r\n\r\n")
            except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError):
                raise Refusal("502 Bad Gateway", _ENDED) from None
            status = STATUS.match(head)
            opened = status is not None and status[1] == b"101"
            if status is None or (opened and not request.websocket):
                raise Refusal("502 Bad Gateway", "an unexpected response")
            if is_page(head):
                try:
                    page = await _read_page(behind)
                    head, page = with_script(head, page)
                except (OSError, EOFError, TimeoutError, ValueError):
                    raise Refusal("502 Bad Gateway", "an unexpected page") from None
                writer.write(response_head(head, opened) + page)
                await _drain(writer, WRITE_SECONDS)
                await _linger(reader, writer)
                return
            writer.write(response_head(head, opened))
            if not opened:
                await _copy(behind, writer, WRITE_SECONDS)
                await _linger(reader, writer)
                return
            _keep_alive(writer)
            heard = self._hear if request.path == "/ui" else None
            directions = {
                asyncio.create_task(_copy(behind, writer)),
                asyncio.create_task(_copy(reader, ahead, heard=heard)),
            }
            try:
                await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for each in directions:
                    each.cancel()
                await asyncio.gather(*directions, return_exceptions=True)
        finally:
            ahead.close()


_WHERE = "Open the address that was printed where the viewer was started; it ends in ?token=..."
_ENDED = "The viewer has ended."
_COOKIE = "lyceum-warp"


def _reachable_address(families: Collection[int]) -> str | None:
    """The address by which other machines probably reach this one; None without a network.

    It is the one by which a session of ssh reached it, else that of the interface with the default route.
    """
    connection = os.environ.get("SSH_CONNECTION", "").split()
    candidates = [connection[2]] if len(connection) == 4 else []
    candidates += [found for family in (socket.AF_INET, socket.AF_INET6) if (found := route_address(family))]
    for candidate in candidates:
        try:
            address = ipaddress.ip_address(candidate)
        except ValueError:
            continue
        if (socket.AF_INET if address.version == 4 else socket.AF_INET6) in families and not address.is_loopback:
            return candidate
    return None


def _in_address(host: str) -> str:
    """A host as it is written in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


async def _answer(writer: asyncio.StreamWriter, refusal: Refusal) -> None:
    body = f"{refusal.text}\n".encode() if refusal.text else b""
    headers = dict(PROTECTION) | {"Content-Type": "text/plain; charset=utf-8"} | dict(refusal.headers)
    headers |= {"Content-Length": str(len(body)), "Connection": "close"}
    lines = [f"HTTP/1.1 {refusal.status}", *(f"{name}: {value}" for name, value in headers.items()), "", ""]
    writer.write("\r\n".join(lines).encode() + body)
    async with asyncio.timeout(HEAD_SECONDS):
        await writer.drain()


async def _copy(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    seconds: float | None = None,
    heard: Callable[[], None] | None = None,
) -> None:
    """Pass on bytes until the end.

    Args:
        reader: Where they come from.
        writer: Where they go.
        seconds: Bounds the wait for a client that takes nothing.
        heard: Called for bytes that came.
    """
    while data := await reader.read(_CHUNK):
        if heard is not None:
            heard()
        writer.write(data)
        await _drain(writer, seconds)


async def _drain(writer: asyncio.StreamWriter, seconds: float | None) -> None:
    async with asyncio.timeout(seconds):
        await writer.drain()


async def _read_page(reader: asyncio.StreamReader) -> bytes:
    """A page up to the end of its connection."""
    page = bytearray()
    async with asyncio.timeout(WRITE_SECONDS):
        while data := await reader.read(_CHUNK):
            page += data
            if len(page) > PAGE_BYTES:
                raise ValueError(f"a page of more than {PAGE_BYTES} bytes")
    return bytes(page)


async def _linger(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """End the response, and read what the client still sends: closing earlier could discard the response."""
    with contextlib.suppress(OSError, TimeoutError):
        writer.write_eof()
        async with asyncio.timeout(1.0):
            for _ in range(16):
                if not await reader.read(_CHUNK):
                    return


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    """Let the system find out within two minutes that a client is gone, as after a laptop's lid was closed."""
    client = writer.get_extra_info("socket")
    client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            client.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
