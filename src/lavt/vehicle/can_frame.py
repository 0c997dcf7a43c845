"""CAN frames as plain values, and the interface of a CAN bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from msgspec import Struct


class CanFrame(Struct, frozen=True):
    """A CAN data frame. The length of `data`, 0 to 8 bytes, is the frame's DLC."""

    identifier: int
    data: bytes
    is_extended: bool = False


class ReceivedCanFrame(Struct, frozen=True):
    """A frame received from the bus, with its arrival time on this host's monotonic clock."""

    frame: CanFrame
    arrived_ns: int


class BusGone(Exception):
    """Raised when the bus cannot be written to or read from; the message gives the reason.

    `written` is the number of frames that were written before the bus was lost.
    """

    def __init__(self, reason: str, written: int = 0) -> None:
        super().__init__(reason)
        self.written = written


class BusPort(Protocol):
    """One participant's access to a CAN bus."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Event counters by name."""
        ...

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Send frames made at `made_ns`, in order and without blocking; return how many were sent. Raises `BusGone`.

        If a frame cannot be sent, the frames after it are not sent either.
        """
        ...

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Return the frames received since the last call, in order. Raises `BusGone`.

        The frames that this port sent are not among them.
        """
        ...

    def next_wake_ns(self) -> int | None:
        """Return a time at which `take` will have a frame to return, or None if no such time is known."""
        ...

    def close(self) -> None:
        """Close the connection to the bus."""
        ...
