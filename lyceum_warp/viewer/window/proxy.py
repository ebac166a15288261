"""Serve studio's page through a reverse proxy with access control.

Studio's own server has no password. This server listens on a private socket (``sockets.py``), which refuses other
processes. The proxy forwards a request only if

- the ``Host`` header is an address or a name of this machine (against DNS rebinding);
- the ``Origin`` and ``Sec-Fetch-*`` headers show that no page of another site sent the request;
- the request has the cookie and the secret path, which a browser receives when it opens the printed address;
- the request is a GET without a body, or opens studio's WebSocket ``/ui`` or ``/state`` (not ``/drop``, which loads
  models).

Browsers send a cookie to all ports of a host, including the servers of other users on the loopback address. The cookie
is therefore limited to a random path (``Path=/RANDOM/``), below which the page is served. Studio's page requests
absolute paths, such as ``/ui``. A script from the proxy adds the random path in front of them.

aiohttp parses requests, and limits their headers to 128 lines of 8 KiB. The proxy runs in a thread.
"""

import asyncio
import contextlib
import getpass
import hmac
import html
import ipaddress
import logging
import os
import re
import secrets
import socket
import threading
from collections.abc import Callable
from typing import Any

import aiohttp
from aiohttp import web
from yarl import URL

from lyceum_warp.viewer.window.sockets import public_sockets

HEAD_SECONDS = 10.0
"""Timeout in seconds for a request's headers and for idle connections."""
WRITE_SECONDS = 60.0
"""Timeout in seconds for a client that does not read."""
UNCHECKED = 128
"""Maximum number of connections without the secret. Each further connection closes the oldest one."""
MESSAGE_BYTES = 2**20
"""Maximum size of a WebSocket message from a browser, in bytes."""
QUIET_SECONDS = 2.0
"""A page without input for this many seconds counts as hidden. An open page sends input with every frame."""
PROTECTION = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors http://localhost:* http://127.0.0.1:*",  # notebooks
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",  # browsers require this for SharedArrayBuffer
    "Document-Isolation-Policy": "isolate-and-require-corp",  # Chromium requires this in notebooks
}
"""These headers stop other sites from embedding the page or getting its address.

A notebook on this machine may embed the page, because the notebook knows the token.
"""
SCRIPT = """<script>
(() => {
  const path = location.pathname.slice(0, location.pathname.indexOf("/", 1));
  const below = (address) => {
    const whole = new URL(address, document.baseURI);
    if (whole.host === location.host && !whole.pathname.startsWith(path + "/")) {
      whole.pathname = path + whole.pathname;
    }
    return whole.href;
  };
  const original = window.fetch;
  window.fetch = (what, options) => original(what instanceof Request ? what : below(what), options);
  let state = null;  // the WebSocket of studio's session
  const say = (what) => state?.readyState === WebSocket.OPEN && state.send(what);
  window.WebSocket = class extends WebSocket {
    constructor(address, protocols = []) {
      super(below(address), protocols);
      if (!new URL(this.url).pathname.endsWith("/state")) return;
      state = this;
      this.addEventListener("open", () => take());
      this.addEventListener("message", (event) => {
        if (typeof event.data !== "string") return;
        if (event.data.includes("role=spectator;queue_pos=0")) say("request_control");
        if (event.data.startsWith("saved=")) {
          event.stopImmediatePropagation();
          offer(event.data.slice(6));
        }
      });
    }
  };
  const offer = (name) => {
    const box = document.getElementById("saved") ?? document.body.appendChild(document.createElement("div"));
    box.id = "saved";
    box.style = "position:fixed;right:12px;bottom:44px;padding:8px;background:#fffd;font:14px sans-serif";
    const link = document.createElement("a");
    Object.assign(link, {href: below("/saved/" + name), download: name, textContent: "\u2b07 " + name});
    link.style = "display:block;color:#06c";
    box.append(link);
    while (box.children.length > 4) box.firstChild.remove();
  };
  Object.defineProperty(document, "title", {get: () => document.querySelector("title").text, set: () => {}});
  const take = () => document.visibilityState === "visible" && say("force_control");
  document.addEventListener("visibilitychange", take);
  window.addEventListener("focus", take);
  try {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    localStorage.mjwv_theme ??= dark ? "dark" : "light";
  } catch {}
})();
</script>"""
"""The script that the proxy inserts into studio's page.

The script prefixes requested addresses with the secret path. It also gives control to the visible tab, shows links to
new files, and keeps the theme and the title.
"""

_PATH = re.compile(r"(/[A-Za-z0-9_~!$&'()*+,;=:@\[\]-][A-Za-z0-9._~!$&'()*+,;=:@\[\]-]*)+|/")
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
_COOKIE = "lyceum-warp"
_WHERE = "Open the address that was printed where the viewer was started; it ends in ?token=..."
_ENDED = "The viewer has ended.\n"
_HEARTBEAT = 30.0  # seconds between pings, which detect a lost browser
_SocketEnd = web.WebSocketResponse | aiohttp.ClientWebSocketResponse


class Proxy:
    """A reverse proxy that forwards requests with the secret to studio's server.

    The constructor opens the port, and ``start`` begins to answer.

    Raises:
        ValueError: The port is out of range or in use, or the address is not an address of this machine.
    """

    def __init__(self, *, host: str = "127.0.0.1", port: int | None = None, title: str = "lyceum_warp") -> None:
        self._title = html.escape(title)
        self._sockets = public_sockets(host, port)
        addresses = [ipaddress.ip_address(each.getsockname()[0].partition("%")[0]) for each in self._sockets]
        self.port: int = self._sockets[0].getsockname()[1]
        self.local = all(address.is_loopback for address in addresses)
        self._token, self._cookie, self._path = (secrets.token_urlsafe(32) for _ in range(3))
        machine = socket.gethostname().lower()
        self._names = {"localhost", machine, machine.partition(".")[0], host.lower()}
        ssh = os.environ.get("SSH_CONNECTION", "").split()  # the client's address and port, then this machine's
        self._ssh = (ssh[2], ssh[3]) if len(ssh) == 4 else (socket.gethostname(), "22")
        everywhere = any(address.is_unspecified for address in addresses)
        self._host = "127.0.0.1" if self.local or everywhere else host
        self._shown_host = self._ssh[0] if everywhere else self._host
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop
        self._stop: asyncio.Event
        self._server: _Server
        self._client: aiohttp.ClientSession
        self._files: dict[str, str] = {}  # paths of the files for download, by name
        self._pages: set[web.WebSocketResponse] = set()
        self._silence: asyncio.TimerHandle | None = None

    @property
    def address(self) -> str:
        """The page's address with the token."""
        return self._address(self._shown_host)

    @property
    def ssh_line(self) -> str:
        """The ssh command that forwards the port to another machine."""
        host, port = self._ssh
        with contextlib.suppress(KeyError, OSError):  # in some containers the user has no name
            host = f"{getpass.getuser()}@{host}"
        target = f"-p {port} {host}" if port != "22" else host
        return f"ssh -C -N -L {self.port}:{_bracketed(self._host)}:{self.port} {target}"

    @property
    def instructions(self) -> list[str]:
        """The lines to print: the address, the ssh command, and a warning if other machines can connect."""
        lines, ssh = [f"viewer: {self.address}"], f"from another machine: {self.ssh_line}"
        if self.local:
            return [*lines, ssh]
        lines.append("warning: other machines can connect, and what they send is not encrypted")
        return [*lines, f"encrypted, {ssh}", f"and open there: {self._address('127.0.0.1')}"]

    def _address(self, host: str) -> str:
        return f"http://{_bracketed(host)}:{self.port}/?token={self._token}"

    def start(self, upstream: tuple[str, int], on_quiet: Callable[[], object] = lambda: None) -> None:
        """Begin to answer in a thread.

        Args:
            upstream: The host and the port of studio's server.
            on_quiet: Called in the proxy's thread after the page that had control was closed or hidden.
        """
        self._upstream, self._on_quiet = "http://{}:{}".format(*upstream), on_quiet
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(ready)), name="viewer-proxy", daemon=True)
        self._thread.start()
        ready.wait()

    def offer(self, file: str) -> None:
        """Offer a file as a download on all open pages. Any thread may call this method."""
        self._loop.call_soon_threadsafe(lambda: self._loop.create_task(self._tell(file)))

    def close(self) -> None:
        """Close the port and all connections."""
        if self._thread is not None and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # the event loop has just ended
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(timeout=5.0)
        for opened in self._sockets:
            opened.close()

    def __enter__(self) -> "Proxy":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # within the thread

    async def _run(self, ready: threading.Event) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._server = _Server(self._answer)
        runner = web.ServerRunner(self._server, shutdown_timeout=0.2)
        timeout = aiohttp.ClientTimeout(total=None, sock_read=WRITE_SECONDS)
        async with aiohttp.ClientSession(timeout=timeout, auto_decompress=False) as self._client:
            await runner.setup()
            for each in self._sockets:
                await web.SockSite(runner, each).start()
            ready.set()
            await self._stop.wait()
            await runner.cleanup()

    async def _tell(self, file: str) -> None:
        name = os.path.basename(file)
        self._files[name] = file
        for page in [*self._pages]:
            with contextlib.suppress(ConnectionError):
                await page.send_str(f"saved={name}")

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            self._check_sender(request)
            if "token" in request.query:
                return self._enter(request)
            target = self._checked_target(request)
            self._server.unchecked.pop(request.protocol, None)
            return await (self._bridge if "Upgrade" in request.headers else self._fetch)(request, target)
        except web.HTTPException as refusal:
            refusal.headers.update(PROTECTION)
            refusal.force_close()
            raise

    def _check_sender(self, request: web.BaseRequest) -> None:
        """Refuse unknown hosts, pages of other sites, and all requests except a plain GET."""
        host = request.headers.get("Host", "").lower()
        match = _HOST.fullmatch(host)
        if match is None:
            raise web.HTTPBadRequest(text="the Host header is missing or malformed\n")
        name = match[1].strip("[]")
        try:
            ipaddress.ip_address(name)  # DNS rebinding needs a name, so an IP address is safe
        except ValueError:
            if name not in self._names:
                text = f"{name} is not a name of this machine; use its address instead\n"
                raise web.HTTPMisdirectedRequest(text=text) from None
        own = (f"http://{host}", f"https://{host}")
        foreign = any(origin.lower() not in own for origin in request.headers.getall("Origin", []))
        # links on any page and iframes on pages of this host are allowed: they open the viewer only with the token
        site, mode, use = (request.headers.get(f"Sec-Fetch-{name}") for name in ("Site", "Mode", "Dest"))
        linked = mode == "navigate" and (use == "document" or (site == "same-site" and use == "iframe"))
        if foreign or (_is_cross_site(request) and not linked):
            raise web.HTTPForbidden(text="a request of another site's page\n")
        if request.method != "GET":
            raise web.HTTPMethodNotAllowed(request.method, ["GET"], text="only GET is allowed\n")
        if request.body_exists:
            raise web.HTTPBadRequest(text="a request with a body\n")

    def _enter(self, request: web.BaseRequest) -> web.Response:
        tokens = request.query.getall("token")
        if len(tokens) > 1 or not _same(tokens[0], self._token):
            raise web.HTTPForbidden(text=f"This token is not the one of this viewer. {_WHERE}\n")
        if "Upgrade" in request.headers or request.path != "/":
            raise web.HTTPBadRequest(text="a token belongs to the first page\n")
        target = f"/{self._path}/"
        headers = {
            **PROTECTION,
            "Set-Cookie": f"{_COOKIE}={self._cookie}; Path={target}; HttpOnly; SameSite=Strict",
            "Cache-Control": "no-store",
        }
        if not _is_cross_site(request):
            return web.Response(status=303, headers={**headers, "Location": target})
        # When the user follows a link on another site, browsers do not send a SameSite=Strict cookie, not even after a
        # redirect. They do send it when a page of the proxy makes the next request, so answer with such a page.
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={target}">'
        return web.Response(text=page, content_type="text/html", headers=headers)

    def _checked_target(self, request: web.BaseRequest) -> str:
        """Check the path and the cookie, and return the target without the secret path."""
        path, question, query = request.raw_path.partition("?")
        first, slash, below = path.removeprefix("/").partition("/")
        wanted = f"{_COOKIE}={self._cookie}"
        cookies = ";".join(request.headers.getall("Cookie", [])).split(";")
        known = any([_same(each.strip(), wanted) for each in cookies])
        if not _same(first, self._path) or not slash or not known:
            raise web.HTTPForbidden(text=f"{_WHERE}\n")
        if _PATH.fullmatch(f"/{below}") is None:
            raise web.HTTPNotFound(text="no such page\n")
        if "Upgrade" in request.headers and below not in ("ui", "state"):
            raise web.HTTPNotFound(text="no such WebSocket\n")
        return f"/{below}{question}{query}"

    async def _fetch(self, request: web.BaseRequest, target: str) -> web.StreamResponse:
        """Return a saved file, or studio's response with only a few of its headers."""
        if target.startswith("/saved/"):
            if (file := self._files.get(target.removeprefix("/saved/"))) is None or not os.path.isfile(file):
                raise web.HTTPNotFound(text="no such file\n")
            return web.FileResponse(file, headers={**PROTECTION, "Content-Disposition": "attachment"})
        try:
            found = await self._client.get(URL(self._upstream + target, encoded=True), allow_redirects=False)
        except (aiohttp.ClientError, TimeoutError):
            raise web.HTTPBadGateway(text=_ENDED) from None
        async with found:
            kept = {name: found.headers[name] for name in ("Content-Type", "Cache-Control") if name in found.headers}
            headers = PROTECTION | kept
            if found.content_type == "text/html":
                begin, tag, rest = (await found.text()).partition("<head>")
                if not tag:
                    raise web.HTTPBadGateway(text="an unexpected page\n")
                rest = re.sub("<title>.*?</title>", lambda _: f"<title>{self._title}</title>", rest, count=1)
                body = (begin + tag + SCRIPT + rest).encode()
                return web.Response(status=found.status, body=body, headers=headers)
            answer = web.StreamResponse(status=found.status, headers=headers)
            answer.content_length = found.content_length
            await answer.prepare(request)
            async for chunk in found.content.iter_any():
                try:
                    async with asyncio.timeout(WRITE_SECONDS):
                        await answer.write(chunk)
                except TimeoutError:
                    assert request.transport is not None
                    request.transport.abort()
                    raise
            return answer

    async def _bridge(self, request: web.BaseRequest, target: str) -> web.StreamResponse:
        browser = web.WebSocketResponse(heartbeat=_HEARTBEAT, compress=False, max_msg_size=MESSAGE_BYTES)
        browser.headers.update(PROTECTION)
        await browser.prepare(request)  # refuses malformed handshakes
        try:
            studio = await self._client.ws_connect(URL(self._upstream + target, encoded=True), max_msg_size=0)
        except (aiohttp.ClientError, TimeoutError):
            await browser.close(code=aiohttp.WSCloseCode.GOING_AWAY, message=_ENDED.encode())
            return browser
        async with studio:
            controls = target.partition("?")[0] == "/ui"
            if not controls:
                self._pages.add(browser)
            try:
                await asyncio.gather(_relay(studio, browser), _relay(browser, studio, self._hear if controls else None))
            finally:
                self._pages.discard(browser)
        return browser

    def _hear(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
        self._silence = self._loop.call_later(QUIET_SECONDS, self._on_quiet)


class _Server(web.Server):
    """Limits the number of unauthenticated connections, and closes slow or idle connections."""

    def __init__(self, handler: Any) -> None:
        super().__init__(
            handler, handler_cancellation=True, keepalive_timeout=HEAD_SECONDS, lingering_time=1.0, access_log=None,
            logger=logging.Logger("viewer-proxy", logging.CRITICAL),  # do not log malformed requests
        )  # fmt: skip
        self.unchecked: dict[web.RequestHandler, None] = {}

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        super().connection_made(handler, transport)
        if len(self.unchecked) >= UNCHECKED:
            next(iter(self.unchecked)).force_close()
        self.unchecked[handler] = None

    def connection_lost(self, handler: web.RequestHandler, exc: BaseException | None = None) -> None:
        super().connection_lost(handler, exc)
        self.unchecked.pop(handler, None)


async def _relay(source: _SocketEnd, sink: _SocketEnd, heard: Callable[[], None] | None = None) -> None:
    """Forward messages until the source is closed. Then close the sink with the same code."""
    code, reason = int(aiohttp.WSCloseCode.GOING_AWAY), ""
    with contextlib.suppress(ConnectionError):  # the sink is already closed
        while True:
            message = await source.receive()
            if heard is not None:
                heard()
            if message.type is aiohttp.WSMsgType.BINARY:
                await sink.send_bytes(message.data)
            elif message.type is aiohttp.WSMsgType.TEXT:
                await sink.send_str(message.data)
            else:
                if message.type is aiohttp.WSMsgType.CLOSE and message.data:
                    code, reason = int(message.data), str(message.extra or "")
                break
    await sink.close(code=code, message=reason.encode())


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), secret.encode())


def _is_cross_site(request: web.BaseRequest) -> bool:
    return request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
