"""The listening sockets of the console."""

from __future__ import annotations

import socket
from contextlib import ExitStack, closing

from lavt.transport.console.listeners import open_listeners


def test_pictures_do_not_wait_for_acknowledgements() -> None:
    """Accepted connections send small messages at once, without Nagle's algorithm."""
    with ExitStack() as stack:
        for listener in open_listeners(0, lambda: True):
            stack.enter_context(closing(listener))
            stack.enter_context(socket.create_connection(listener.getsockname()[:2]))
            connection = stack.enter_context(closing(listener.accept()[0]))
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
