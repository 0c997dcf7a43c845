"""When a datagram arrived, by the kernel: a process that comes late to its socket must not count as delay."""

from __future__ import annotations

import socket
import struct

from lavt.domain import NS_PER_S, Now

SO_TIMESTAMPNS = 35
"""Linux: time of arrival as two 64-bit numbers, seconds and nanoseconds of the wall clock; not named in `socket`."""
ANCILLARY_BYTES = 64
"""Room for it in `recvmsg`."""
QUEUED_LONGEST_NS = 10 * NS_PER_S
"""A kernel's stamp further back than this is not believed: the wall clock was stepped in between."""

Ancillary = list[tuple[int, int, bytes]]


def enable_arrival_times(opened: socket.socket) -> None:
    """Ask the kernel to stamp what comes in on a socket; where it cannot, `arrival` gives the time of reading."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError:
        return


def arrival(ancillary: Ancillary, now: Now) -> Now:
    """Bring the kernel's stamp, which is wall time, to both clocks; without one it is `now`, the time of reading."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(data) >= 16:
            seconds, nanoseconds = struct.unpack_from("qq", data)
            queued_ns = now.wall_ns - (seconds * NS_PER_S + nanoseconds)
            if 0 <= queued_ns < QUEUED_LONGEST_NS:
                return now.later(-queued_ns)
    return now
