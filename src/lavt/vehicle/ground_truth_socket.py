"""A non-blocking UDP socket that receives a software car's ground truth on the same machine."""

from __future__ import annotations

import socket
from collections.abc import Mapping

from lavt.domain import GroundTruth, VehicleEvent
from lavt.errors import UserError
from lavt.vehicle.ground_truth_wire import MAX_BYTES, TruthReceiver

MAX_DATAGRAMS = 256
"""Largest number of datagrams that one call reads: about as many as a software car sends in a second."""


class TruthSocket:
    """A socket for datagrams of `lavt.vehicle.ground_truth_wire`. Raises `UserError` if its address cannot be bound."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._receiver = TruthReceiver()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"cannot receive a software car's ground truth on {address[0]}:{address[1]} ({error.strerror}): choose "
                "another vehicle.dbw.truth"
            ) from None

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters of received datagrams."""
        return self._receiver.counts

    def take(self, _now_ns: int) -> tuple[GroundTruth | None, list[VehicleEvent]]:
        """Return the newest ground truth, or None before the first one, and the events since the last call."""
        events: list[VehicleEvent] = []
        for _ in range(MAX_DATAGRAMS):
            try:
                datagram = self._socket.recv(MAX_BYTES + 1)
            except BlockingIOError:
                break
            events += self._receiver.receive(datagram)
        return self._receiver.newest, events

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
