"""Open listening sockets: public ones for browsers, and private ones for this process only."""

import contextlib
import errno
import os
import socket
import stat
from typing import Any

FIRST_PORT, PORTS = 8080, 20
"""By default, these ports are tried before any free port."""

_LOOPBACK = ("127.0.0.1", "::1")


class _PrivateSocket(socket.socket):
    """A listening socket that refuses connections from other processes."""

    def accept(self) -> tuple[socket.socket, Any]:
        connection, address = super().accept()
        if not _is_own(connection):
            connection.close()
            raise ConnectionAbortedError("another process tried to connect")  # event loops ignore this type of error
        return connection, address


def private_socket() -> socket.socket:
    """Listen on a free port of 127.0.0.1, and accept connections from this process only.

    All users of a machine can connect to its loopback address.
    """
    private = _PrivateSocket(socket.AF_INET, socket.SOCK_STREAM)
    private.bind(("127.0.0.1", 0))
    private.listen()
    return private


def _is_own(connection: socket.socket) -> bool:
    try:
        ends = connection.getpeername(), connection.getsockname()
    except OSError:  # the peer has closed the connection
        return False
    for name in os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"):
        with contextlib.suppress(OSError):  # the descriptor may be closed by now, or the socket may not be connected
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                peer = socket.socket(fileno=int(name))
                try:
                    if (peer.getsockname(), peer.getpeername()) == ends:
                        return True
                finally:
                    peer.detach()
    return False


def public_sockets(host: str, port: int | None) -> list[socket.socket]:
    """Listen on the same port of all addresses of a host.

    Raises:
        ValueError: The port is out of range or in use, or the address is not an address of this machine.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ValueError(f"port {port} is out of range: choose one from 0 to 65535")
    candidates = [*range(FIRST_PORT, FIRST_PORT + PORTS), 0] if port is None else [port]
    for candidate in candidates:
        try:
            return _listen(host, candidate)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and candidate != candidates[-1]:
                continue
            if isinstance(error, socket.gaierror):
                raise ValueError(f"cannot listen on {host!r}: no address of that name is known") from error
            hints = {
                errno.EADDRINUSE: f"port {candidate} is in use: choose another one, or none to take a free one",
                errno.EADDRNOTAVAIL: f"cannot listen on {host!r}: this machine has no such address",
                errno.EACCES: f"may not listen on port {candidate}: choose one from 1024 to 65535",
            }
            other = f"cannot listen on {host!r}, port {candidate}: {error.strerror}"
            raise ValueError(hints.get(error.errno or 0, other)) from error
    raise AssertionError


def _listen(host: str, port: int) -> list[socket.socket]:
    # take both loopback addresses, because another program could listen on the second and pose as the viewer
    names = _LOOPBACK if host in ("", "localhost", *_LOOPBACK) else ("0.0.0.0", "::") if host == "::" else (host,)
    opened: list[socket.socket] = []
    with contextlib.ExitStack() as failed:
        for name in names:
            for family, _, _, _, address in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM):
                try:
                    opened.append(socket.create_server((str(address[0]), port), family=family))
                except OSError as error:
                    if opened and error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                        continue  # a machine without IPv6
                    raise
                failed.enter_context(opened[-1])
                port = opened[0].getsockname()[1]
        failed.pop_all()
    return opened
