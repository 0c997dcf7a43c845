"""Where a software car's truth is heard: a UDP socket of this machine that never waits."""

from __future__ import annotations

import socket
from collections.abc import Mapping

from lavt.domain import GroundTruth, VehicleEvent
from lavt.errors import UserError
from lavt.vehicle.ground_truth_wire import MAX_BYTES, TruthReceiver

MOST = 256
"""So many datagrams are taken at a time: a second of them."""


class TruthSocket:
    """Hears `lavt.vehicle.ground_truth_wire` on an address; raises `UserError` where it cannot."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._receiver = TruthReceiver()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"the truth of a software car cannot be heard on {address[0]}:{address[1]} ({error.strerror}): choose "
                "another vehicle.dbw.truth"
            ) from None

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    @property
    def counts(self) -> Mapping[str, int]:
        """What came."""
        return self._receiver.counts

    def take(self, _now_ns: int) -> tuple[GroundTruth | None, list[VehicleEvent]]:
        """Give the newest truth, None before there was one, and what has happened since the last call."""
        events: list[VehicleEvent] = []
        for _ in range(MOST):
            try:
                datagram = self._socket.recv(MAX_BYTES + 1)
            except BlockingIOError:
                break
            events += self._receiver.take(datagram)
        return self._receiver.newest, events

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
