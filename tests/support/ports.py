"""Free ports of this machine, which no socket of another test takes before the test that got them uses them."""

from __future__ import annotations

import itertools
import os
import socket
from contextlib import closing
from typing import Final

FIRST, LAST = 20_000, 32_767
"""Below the ports that the system gives to sockets without a port of their own (Linux: from 32768)."""
STRIDE: Final = 499
"""Tests that run at the same time, in processes with other numbers, begin this far from each other."""
_numbers = itertools.count(os.getpid() * STRIDE)


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Return a port that is free at every address: a UDP port, or with `SOCK_STREAM` a TCP port."""
    while True:
        port = FIRST + next(_numbers) % (LAST - FIRST + 1)
        if _is_free(port, kind):
            return port


def free_port_pair(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Return the first of two consecutive free ports, as for RTP and RTCP."""
    while True:
        port = free_port(kind)
        if _is_free(port + 1, kind):
            next(_numbers)
            return port


def _is_free(port: int, kind: socket.SocketKind) -> bool:
    with closing(socket.socket(socket.AF_INET, kind)) as trial:
        try:
            trial.bind(("", port))
        except OSError:
            return False
    return True
