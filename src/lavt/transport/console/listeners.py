"""The listening sockets of the console, at the loopback addresses of this machine, and a limit for what they accept."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable
from typing import Any, Final

from lavt.errors import UserError

PORT_ATTEMPTS: Final = 10
PAUSED: Final = "too many connections"


class LimitedListener(socket.socket):
    """A listening socket that accepts connections while `may_accept()` is true."""

    may_accept: Callable[[], bool]
    _has_paused = False

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; above the limit, close it and raise the error after which asyncio accepts none for 1 s.

        The other connections wait in the kernel until then, and cost nothing.
        """
        if self._has_paused:  # some versions of Python try the next connection before they pause
            self._has_paused = False
            raise BlockingIOError
        connection, address = super().accept()
        if not self.may_accept():
            connection.close()
            self._has_paused = True
            raise OSError(errno.EMFILE, PAUSED)
        # Or else a picture waits up to 40 ms for the acknowledgement of the one before it (Nagle's algorithm).
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection, address


def ignore_paused_accepts(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print nothing about a limited listener: anybody on this machine can make too many connections."""
    error = context.get("exception")
    if not (isinstance(error, OSError) and error.strerror == PAUSED):
        loop.default_exception_handler(context)


def open_listeners(port: int, may_accept: Callable[[], bool]) -> list[socket.socket]:
    """Return listening sockets at 127.0.0.1 and ::1 with the same port; without IPv6, only the first.

    Both are needed: another program at the port of ::1 would get what a browser sends to `localhost`.
    """
    for attempt in range(PORT_ATTEMPTS):
        is_last = port != 0 or attempt == PORT_ATTEMPTS - 1
        first = _listen(socket.AF_INET, "127.0.0.1", port, may_accept)
        if isinstance(first, OSError):
            raise UserError(f"the console's port {port} cannot be opened ({first.strerror}): choose another, or 0")
        number = first.getsockname()[1]
        second = _listen(socket.AF_INET6, "::1", number, may_accept)
        if not isinstance(second, OSError):
            return [first, second]
        if not has_ipv6():
            return [first]
        first.close()
        if is_last:
            raise UserError(f"the console's port {number} is used at ::1 ({second.strerror}): choose another, or 0")
    raise AssertionError


def _listen(
    family: socket.AddressFamily, host: str, port: int, may_accept: Callable[[], bool]
) -> socket.socket | OSError:
    try:
        listener = LimitedListener(family, socket.SOCK_STREAM)
    except OSError as error:
        return error
    listener.may_accept = may_accept
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind((host, port))
        listener.listen()
    except OSError as error:
        listener.close()
        return error
    return listener


def has_ipv6() -> bool:
    """Return whether this machine has the address ::1."""
    probe = _listen(socket.AF_INET6, "::1", 0, lambda: True)
    if isinstance(probe, OSError):
        return False
    probe.close()
    return True
