"""A small NTP server with an independent clock, and exchanges with such a server (RFC 5905, figure 8).

    python -m tests.kernel.lane.ntp_server ADDRESS PORT [OFFSET_NS DRIFT_PPM]

With an offset, the server's clock starts that far ahead of the machine's wall clock and runs fast by the drift. Later
changes of the wall clock do not affect it. Without an offset, the server serves the machine's wall clock.
"""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Callable

from tests.kernel.lane.clocks import NS_PER_S, read_raw_clock_ns, wall_minus_raw_ns

from lavt.clock import MachineClock

HEADER = struct.Struct("!BBbbII4sQQQQ")
"""The header of an NTP packet: one byte with leap indicator, version and mode; stratum; poll interval; precision; root
delay; root dispersion; reference identifier; the time stamps reference, origin, receive and transmit."""
FROM_CLIENT, FROM_SERVER = 0x23, 0x24
"""Leap 0 and version 4, with the mode of a client (3) or of a server (4)."""
EPOCH_S = 2_208_988_800
"""Seconds from 1900 to 1970."""

Clock = Callable[[], int]


def machine_wall_ns() -> int:
    """Return this machine's wall clock."""
    return MachineClock().now().wall_ns


def independent_clock(offset_ns: int, drift_ppm: float) -> Clock:
    """Return a clock that is set from the machine's wall clock once, and then runs independently."""
    begin_raw_ns = read_raw_clock_ns()
    begin_wall_ns = begin_raw_ns + wall_minus_raw_ns() + offset_ns

    def read() -> int:
        elapsed_ns = read_raw_clock_ns() - begin_raw_ns
        return begin_wall_ns + elapsed_ns + round(elapsed_ns * drift_ppm / 1e6)

    return read


def serve(address: str, port: int, clock: Clock) -> None:
    """Answer requests for ever; print a line when ready."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((address, port))
        print("{}", flush=True)
        while True:
            request, client = server.recvfrom(2048)
            received = to_ntp(clock())
            if len(request) < HEADER.size or request[0] & 7 != FROM_CLIENT & 7:  # not a client's request
                continue
            _, _, poll, *_, sent = HEADER.unpack(request[: HEADER.size])
            answer = HEADER.pack(FROM_SERVER, 1, poll, -20, 0, 0, b"TEST", received, sent, received, to_ntp(clock()))
            server.sendto(answer, client)


def query_offset(address: str, port: int, exchanges: int = 50) -> tuple[int, int]:
    """Return the server's clock minus this machine's and the round trip, both in ns, of the fastest exchange."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(2)
        client.connect((address, port))
        return min((_exchange(client) for _ in range(exchanges)), key=lambda exchange: exchange[1])


def _exchange(client: socket.socket) -> tuple[int, int]:
    """Return the server's clock minus this machine's and the round trip, both in ns, of one exchange."""
    sent_ns = machine_wall_ns()
    client.send(HEADER.pack(FROM_CLIENT, 0, 0, 0, 0, 0, b"", 0, 0, 0, to_ntp(sent_ns)))
    answer = client.recv(2048)
    returned_ns = machine_wall_ns()
    received_ns, replied_ns = (from_ntp(stamp) for stamp in HEADER.unpack(answer[: HEADER.size])[-2:])
    offset_ns = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
    round_trip_ns = (returned_ns - sent_ns) - (replied_ns - received_ns)
    return offset_ns, round_trip_ns


def to_ntp(wall_ns: int) -> int:
    """Convert nanoseconds since 1970 to seconds since 1900 in 64 bits, 32 of them for the fraction."""
    return ((wall_ns << 32) // NS_PER_S + (EPOCH_S << 32)) & (2**64 - 1)


def from_ntp(stamp: int) -> int:
    """Convert an NTP time stamp to nanoseconds since 1970; up to half a nanosecond is lost."""
    return ((stamp - (EPOCH_S << 32)) * NS_PER_S) >> 32


if __name__ == "__main__":
    clock = independent_clock(int(sys.argv[3]), float(sys.argv[4])) if len(sys.argv) > 3 else machine_wall_ns
    serve(sys.argv[1], int(sys.argv[2]), clock)
