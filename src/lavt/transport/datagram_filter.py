"""Cheap checks of the datagrams at the vehicle's UDP ports, before anything is queued or recorded.

The active client's datagrams pass. All other datagrams pass at a limited rate: the record shows them, but a flood
delays nothing. A filter is not thread-safe: only the receiving thread uses it.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, Final, Protocol

from lavt.domain import Now
from lavt.transport.security.flood_filter import RateLimiter
from lavt.transport.udp_link import Deliver
from lavt.transport.video.path_validation import Address, PathServer, client_datagram_number, is_path_datagram

OTHER_DATAGRAMS_PER_S: Final = 200
"""The limit at the video's port. On a busy AMD EPYC, a stranger's datagram that passed took 15 to 30 us of CPU time. A
datagram that did not pass took a quarter to an eighth of that (`benchmarks/stranger_datagrams.py`, medians of three
runs)."""
PROBES_PER_S: Final = 200
"""The limit for the probes of the active client's host, and again for the probes of all other hosts together. A client
sends 2 a second, `lavt clock` 20."""


class DatagramFilter(Protocol):
    """A filter of the datagrams at one port."""

    def passes(self, datagram: bytes, address: Address, now_ns: int) -> bool:
        """Return whether a datagram from `address` is worth processing."""
        ...


class VideoPortFilter:
    """A filter that passes RTCP from the address of the open path, and each authentic hello and challenge answer once.

    Of all other datagrams, including replays, 200 a second pass.
    """

    def __init__(self, path: PathServer) -> None:
        self._path = path
        self._limiter = RateLimiter(OTHER_DATAGRAMS_PER_S)
        self._token: bytes | None = None
        self._numbers: dict[int, int] = {}
        """The highest number of an authentic hello and of an authentic answer under the token."""

    def passes(self, datagram: bytes, address: Address, now_ns: int) -> bool:
        """Return whether a datagram from `address` is worth processing."""
        is_expected = self._admit_new(datagram) if is_path_datagram(datagram) else self._path.accepts_rtcp_from(address)
        return is_expected or self._limiter.take(now_ns)

    def _admit_new(self, datagram: bytes) -> bool:
        """Note a hello or answer; return whether it is authentic and its number is new."""
        number = client_datagram_number(datagram)
        if number is None:
            return False
        if self._path.token is not self._token:
            self._token, self._numbers = self._path.token, {}
        kind = datagram[4]  # hello or answer
        if number <= self._numbers.get(kind, 0) or not self._path.is_authentic(datagram):
            return False
        self._numbers[kind] = number
        return True


class ProbePortFilter:
    """A filter that passes 200 datagrams a second of the host with the open video path, and 200 of all other hosts."""

    def __init__(self, path: PathServer) -> None:
        self._path = path
        self._limiters = {True: RateLimiter(PROBES_PER_S), False: RateLimiter(PROBES_PER_S)}
        """The key is whether the video's path is open to the sender's host."""

    def passes(self, _datagram: bytes, address: Address, now_ns: int) -> bool:
        """Return whether a datagram from `address` is worth processing."""
        return self._limiters[self._path.is_open_to_host(address[0])].take(now_ns)


def filtered(deliver: Deliver, datagram_filter: DatagramFilter, counts: Counter[str]) -> Deliver:
    """Return a `deliver` that drops the datagrams that do not pass, and counts them in `counts`."""

    def deliver_passing(channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if datagram_filter.passes(payload, peer, arrived.mono_ns):
            deliver(channel, payload, arrived, peer)
        else:
            counts["datagrams_screened_out"] += 1

    return deliver_passing
