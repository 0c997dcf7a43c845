"""Free ports of this machine."""

from __future__ import annotations

import socket
from contextlib import closing


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Return a port that is free at every address: a UDP port, or with `SOCK_STREAM` a TCP port."""
    with closing(socket.socket(socket.AF_INET, kind)) as trial:
        trial.bind(("", 0))
        port: int = trial.getsockname()[1]
        return port


def free_port_pair() -> int:
    """Return the first of two consecutive free UDP ports; some tools expect RTP at the first and RTCP at the second."""
    while True:
        port = free_port()
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as second:
            try:
                second.bind(("", port + 1))
            except (OSError, OverflowError):
                continue
            return port
