"""What the front passes on: rules for a browser's requests and for the viewer's responses, without the secret."""

import base64
import binascii
import dataclasses
import hmac
import html
import re

_FIELD = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t\x20-\x7e\x80-\xff]*?)[ \t]*")
_REQUEST = re.compile(rb"([A-Z]+) (/[\x21-\x7e]*) HTTP/1\.1")
STATUS = re.compile(rb"HTTP/1\.1 ([2-5][0-9]{2}|101) [^\r\n]*\r\n")
_PATH = re.compile(r"(/[A-Za-z0-9_~!$&'()*+,;=:@\[\]-][A-Za-z0-9._~!$&'()*+,;=:@\[\]-]*)+|/")
HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::([0-9]{1,5}))?")

PROTECTION = (
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("X-Frame-Options", "DENY"),
    ("Content-Security-Policy", "frame-ancestors 'none'"),
)
"""Headers of every response: other sites can neither read nor embed it, and an address is never passed to them."""


class Refusal(Exception):  # noqa: N818
    """The answer of the front to a request that it does not pass on; an error, except for that to a token."""

    def __init__(self, status: str, text: str, headers: tuple[tuple[str, str], ...] = ()) -> None:
        super().__init__(text)
        self.status, self.text, self.headers = status, text, headers


@dataclasses.dataclass(frozen=True)
class Request:
    """A request without a body."""

    method: str
    target: str
    headers: dict[str, str]
    """By names in lower case."""

    @property
    def path(self) -> str:
        """The target without its query."""
        return self.target.partition("?")[0]

    @property
    def websocket(self) -> bool:
        """Whether it asks for a WebSocket, or for another protocol."""
        return "upgrade" in self.headers


def parse(head: bytes) -> Request:
    """The request that a head describes, without its last empty line."""
    line, *fields = head.split(b"\r\n")
    request = _REQUEST.fullmatch(line)
    if request is None:
        raise Refusal("400 Bad Request", "not a request of HTTP/1.1")
    headers: dict[str, str] = {}
    for field in fields:
        match = _FIELD.fullmatch(field)
        if match is None:
            raise Refusal("400 Bad Request", "malformed header")
        name = match[1].decode().lower()
        if name in headers:
            raise Refusal("400 Bad Request", f"header {name} comes twice")
        headers[name] = match[2].decode("latin-1")
    if "transfer-encoding" in headers or headers.get("content-length", "0") != "0":
        raise Refusal("400 Bad Request", "a request with a body")
    return Request(request[1].decode(), request[2].decode(), headers)


def same(given: str, secret: str) -> bool:
    """Compare in a time that does not depend on where the two differ."""
    return hmac.compare_digest(given.encode(), secret.encode())


def check_origin(request: Request) -> None:
    """Refuse what another site's page asked for."""
    headers = request.headers
    own = headers["host"].lower()
    if headers.get("origin", f"http://{own}").lower() not in (f"http://{own}", f"https://{own}"):
        raise Refusal("403 Forbidden", "a request of another site's page")
    # a link on another page may lead here; its token decides
    link = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
    if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not link:
        raise Refusal("403 Forbidden", "a request of another site's page")


def check_target(request: Request) -> None:
    """Refuse what the viewer does not offer, and other models."""
    if request.method != "GET":
        raise Refusal("405 Method Not Allowed", "only GET is allowed", (("Allow", "GET"),))
    if _PATH.fullmatch(request.path) is None:
        raise Refusal("404 Not Found", "no such page")
    if request.path == "/drop":
        raise Refusal("403 Forbidden", "A viewer shows one model; another one cannot be dropped onto its page.")
    if not request.websocket:
        return
    if request.path not in ("/ui", "/state"):
        raise Refusal("404 Not Found", "no such WebSocket")
    try:
        key = base64.b64decode(request.headers.get("sec-websocket-key", ""), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    options = [option.strip().lower() for option in request.headers.get("connection", "").split(",")]
    if (
        request.headers["upgrade"].lower() != "websocket"
        or "upgrade" not in options
        or request.headers.get("sec-websocket-version") != "13"
        or len(key) != 16
    ):
        raise Refusal("400 Bad Request", "malformed WebSocket handshake")


def enter(request: Request, target: str, cookie: str) -> Refusal:
    """The answer to a right token: the cookie with its path, and the page without the token in its address."""
    headers = ("Set-Cookie", f"{cookie}; HttpOnly; SameSite=Strict"), ("Cache-Control", "no-store")
    if request.headers.get("sec-fetch-site", "none") in ("none", "same-origin"):
        return Refusal("303 See Other", "", (*headers, ("Location", target)))
    # A browser that follows a link of another site does not send the cookie (SameSite=Strict), and neither when that
    # link's answer redirects it. It sends the cookie when a page of the front leads on.
    return Refusal("200 OK", leading_to(target), (*headers, ("Content-Type", "text/html; charset=utf-8")))


def leading_to(address: str) -> str:
    """A page that opens another one at once."""
    return f'<!doctype html><meta http-equiv="refresh" content="0; url={html.escape(address)}">'


def request_head(request: Request) -> bytes:
    """The head that the private server gets: only parts that were checked."""
    lines = [f"GET {request.target} HTTP/1.1", "Host: localhost"]
    if request.websocket:
        key = request.headers["sec-websocket-key"]
        lines += ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}"]
    else:
        lines += ["Connection: close"]
    return "\r\n".join([*lines, "", ""]).encode()


def response_head(head: bytes, opened: bool) -> bytes:
    """A response's head with the front's protection, and without permissions for other sites."""
    lines = head[:-4].split(b"\r\n")
    own = {name.lower().encode() for name, _ in PROTECTION} | (set() if opened else {b"connection", b"keep-alive"})
    kept = lines[:1]
    for line in lines[1:]:
        name = line.partition(b":")[0].lower()
        if name not in own and not name.startswith(b"access-control-"):
            kept.append(line)
    kept += [f"{name}: {value}".encode() for name, value in PROTECTION]
    if not opened:
        kept.append(b"Connection: close")
    return b"\r\n".join([*kept, b"", b""])


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
  window.WebSocket = class extends WebSocket {
    constructor(address, protocols = []) {
      super(below(address), protocols);
    }
  };
})();
</script>"""
"""Puts the path of the page before the addresses that it asks for from the root of the host."""


def is_page(head: bytes) -> bool:
    """Whether a response's head describes a page."""
    return any(line.lower().startswith(b"content-type: text/html") for line in head.split(b"\r\n"))


def with_script(head: bytes, page: bytes) -> tuple[bytes, bytes]:
    """A response's head and its page, with the script as the first part of the page's own head.

    Raises:
        ValueError: The page has no head, or is not complete.
    """
    begin, tag, rest = page.partition(b"<head>")
    if not tag:
        raise ValueError("a page without <head>")
    lines = head[:-4].split(b"\r\n")
    lengths = [line for line in lines if line.lower().startswith(b"content-length:")]
    if any(int(line.partition(b":")[2]) != len(page) for line in lengths):
        raise ValueError("an incomplete page")
    lines = [line for line in lines if line not in lengths]
    page = begin + tag + SCRIPT.encode() + rest
    return b"\r\n".join([*lines, f"Content-Length: {len(page)}".encode(), b"", b""]), page
