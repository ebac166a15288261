"""Listening sockets: a public one for browsers, and private ones that only this process can connect to."""

import contextlib
import errno
import os
import socket
import stat
from collections.abc import Iterator
from typing import Any

FIRST_PORT = 8080
PORTS = 20
"""Without a port the front takes the first free one of these; if all are in use, any free one."""


class _PrivateSocket(socket.socket):
    """A listening socket that drops connections of other processes."""

    def accept(self) -> tuple[socket.socket, Any]:
        connection, address = super().accept()
        if not _is_own(connection):
            connection.close()
            raise ConnectionAbortedError("a connection of another process")  # event loops go on after it
        return connection, address


def private_socket() -> socket.socket:
    """A socket that listens on a free port of 127.0.0.1, and that only this process can connect to.

    Other processes of the machine, also those of other users, can reach any port of the loopback address. The socket
    closes a connection before it reads from it unless its other end is a socket of this process.
    """
    private = _PrivateSocket(socket.AF_INET, socket.SOCK_STREAM)
    private.bind(("127.0.0.1", 0))
    private.listen()
    return private


def _is_own(connection: socket.socket) -> bool:
    """Whether the other end of a connection is a socket of this process."""
    try:
        ends = (connection.getpeername(), connection.getsockname())
    except OSError:  # closed by the other end
        return False
    return any(pair == ends for pair in _own_connections())


def _own_connections() -> Iterator[tuple[Any, Any]]:
    """Addresses of every connected socket of this process: its own and that of the other end."""
    for name in os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"):
        with contextlib.suppress(OSError):  # closed meanwhile, or not connected
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                own = socket.socket(fileno=int(name))
                try:
                    yield own.getsockname(), own.getpeername()
                finally:
                    own.detach()


def public_sockets(host: str, port: int | None) -> list[socket.socket]:
    """Listening sockets of all addresses of a host, with the same port."""
    if port is not None:
        if not 0 <= port <= 65535:
            raise ValueError(f"port {port} is out of range: choose one from 0 to 65535")
        return _listen(host, port)
    for candidate in range(FIRST_PORT, FIRST_PORT + PORTS):
        try:
            return _listen(host, candidate)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    return _listen(host, 0)


def _listen(host: str, port: int) -> list[socket.socket]:
    # both loopback addresses: on one that is left out another program could pose as the viewer
    if host in ("", "localhost", "127.0.0.1", "::1"):
        hosts = ["127.0.0.1", "::1"]
    else:
        hosts = ["0.0.0.0", "::"] if host == "::" else [host]
    sockets: list[socket.socket] = []
    try:
        for name in hosts:
            for family, address in _addresses(name):
                if family == socket.AF_INET6 and not _has_address(address):
                    continue  # a machine without IPv6
                taken = sockets[0].getsockname()[1] if sockets else port
                sockets.append(_listening_socket(family, (address, taken)))
    except OSError:
        for opened in sockets:
            opened.close()
        raise
    if not sockets:
        raise OSError(errno.EADDRNOTAVAIL, f"cannot listen on {host!r}: this machine has no such address")
    return sockets


def _addresses(host: str) -> list[tuple[int, str]]:
    try:
        infos = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (socket.gaierror, UnicodeError):
        raise OSError(errno.EADDRNOTAVAIL, f"cannot listen on {host!r}: no address of that name is known") from None
    return list(dict.fromkeys((info[0], str(info[4][0])) for info in infos))


def _has_address(address: str) -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as trial:
            trial.bind((address, 0))
    except OSError:
        return address not in ("::", "::1")  # any other address was asked for, and its error is reported
    return True


def _listening_socket(family: int, address: tuple[str, int]) -> socket.socket:
    opened = socket.socket(family, socket.SOCK_STREAM)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        opened.bind(address)
        opened.listen(128)
    except OSError as error:
        opened.close()
        host, port = address
        hints = {
            errno.EADDRINUSE: f"port {port} is in use: choose another one, or none to take a free one",
            errno.EADDRNOTAVAIL: f"cannot listen on {host!r}: this machine has no such address",
            errno.EACCES: f"may not listen on port {port}: choose one from 1024 to 65535",
        }
        hint = hints.get(error.errno or 0, f"cannot listen on {host!r}, port {port}: {error.strerror}")
        raise OSError(error.errno, hint) from None
    return opened


def route_address(family: int) -> str | None:
    """The address of the interface with the default route; None without one."""
    elsewhere = ("192.0.2.1", 9) if family == socket.AF_INET else ("2001:db8::1", 9)  # of documentation
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as trial:
            trial.connect(elsewhere)  # sends nothing
            address: str = trial.getsockname()[0]
    except OSError:
        return None
    return address
