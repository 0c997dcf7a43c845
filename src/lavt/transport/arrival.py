"""Arrival times of datagrams from the kernel. They do not depend on when the process reads its socket."""

from __future__ import annotations

import socket
import struct

from lavt.domain import NS_PER_S, Now

SO_TIMESTAMPNS = 35
"""Linux's socket option, which `socket` lacks: the time of arrival as two 64-bit numbers, seconds and nanoseconds of
the wall clock."""
ANCILLARY_BYTES = 64
"""The buffer size for ancillary data in `recvmsg`."""
MAX_QUEUED_NS = 10 * NS_PER_S
"""A kernel timestamp that is older is ignored: the wall clock was stepped after the arrival."""

Ancillary = list[tuple[int, int, bytes]]


def enable_arrival_times(opened: socket.socket) -> None:
    """Enable kernel timestamps of received datagrams; without support `arrival` returns the time of reading."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError:
        return


def arrival(ancillary: Ancillary, now: Now) -> Now:
    """Return the time of arrival on both clocks, from the kernel's wall-clock timestamp.

    Without a plausible timestamp, return `now`, the time of reading.
    """
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(data) >= 16:
            seconds, nanoseconds = struct.unpack_from("qq", data)
            queued_ns = now.wall_ns - (seconds * NS_PER_S + nanoseconds)
            if 0 <= queued_ns < MAX_QUEUED_NS:
                return now.later(-queued_ns)
    return now
