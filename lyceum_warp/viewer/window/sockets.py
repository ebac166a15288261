"""Open the listening sockets: public ones for browsers, and private ones that only this process can connect to."""

import contextlib
import errno
import os
import socket
import stat
from collections.abc import Iterator
from typing import Any

FIRST_PORT, PORTS = 8080, 20
"""Without a given port the first free one of these is taken; if all are in use, any free one."""

_LOOPBACK = ("127.0.0.1", "::1")


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
    closes a connection before it reads from it unless its peer is a socket of this process.
    """
    private = _PrivateSocket(socket.AF_INET, socket.SOCK_STREAM)
    private.bind(("127.0.0.1", 0))
    private.listen()
    return private


def _is_own(connection: socket.socket) -> bool:
    """Whether the peer of a connection is a socket of this process."""
    try:
        ends = (connection.getpeername(), connection.getsockname())
    except OSError:  # closed by the peer
        return False
    return any(pair == ends for pair in _own_connections())


def _own_connections() -> Iterator[tuple[Any, Any]]:
    """Own address and peer address of every connected socket of this process."""
    for name in os.listdir("/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"):
        with contextlib.suppress(OSError):  # closed meanwhile, or not connected
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                own = socket.socket(fileno=int(name))
                try:
                    yield own.getsockname(), own.getpeername()
                finally:
                    own.detach()


def public_sockets(host: str, port: int | None) -> list[socket.socket]:
    """Listening sockets of all addresses of a host, with the same port.

    Raises:
        ValueError: The port is out of range or in use, or the address is not one of this machine.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ValueError(f"port {port} is out of range: choose one from 0 to 65535")
    candidates = [*range(FIRST_PORT, FIRST_PORT + PORTS), 0] if port is None else [port]
    while True:
        candidate = candidates.pop(0)
        try:
            return _listen(host, candidate)
        except socket.gaierror:
            reason = f"cannot listen on {host!r}: no address of that name is known"
        except OSError as error:
            if error.errno == errno.EADDRINUSE and candidates:
                continue
            hints = {
                errno.EADDRINUSE: f"port {candidate} is in use: choose another one, or none to take a free one",
                errno.EADDRNOTAVAIL: f"cannot listen on {host!r}: this machine has no such address",
                errno.EACCES: f"may not listen on port {candidate}: choose one from 1024 to 65535",
            }
            reason = hints.get(error.errno or 0, f"cannot listen on {host!r}, port {candidate}: {error.strerror}")
        raise ValueError(reason)


def _listen(host: str, port: int) -> list[socket.socket]:
    # both loopback addresses: on one that is left out another program could pose as the viewer
    names = _LOOPBACK if host in ("", "localhost", *_LOOPBACK) else ("0.0.0.0", "::") if host == "::" else (host,)
    with contextlib.ExitStack() as failed:
        opened: list[socket.socket] = []
        for name in names:
            for family, _, _, _, address in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM):
                taken = opened[0].getsockname()[1] if opened else port
                try:
                    opened.append(socket.create_server((str(address[0]), taken), family=family))
                except OSError as error:
                    if opened and error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                        continue  # a machine without IPv6
                    raise
                failed.enter_context(opened[-1])
        failed.pop_all()
    return opened


def reachable_address(families: set[int]) -> str | None:
    """The address by which other machines probably reach this one; None without a network.

    It is the one by which a session of ssh reached it, else that of the interface with the default route.
    """
    connection = os.environ.get("SSH_CONNECTION", "").split()
    if len(connection) == 4 and (socket.AF_INET6 if ":" in connection[2] else socket.AF_INET) in families:
        return connection[2]
    for family, elsewhere in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):  # of documentation
        if family in families:
            with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as trial:
                trial.connect((elsewhere, 9))  # sends nothing
                found: str = trial.getsockname()[0]
                return found
    return None
