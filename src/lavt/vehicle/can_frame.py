"""CAN frames as plain values, and what they come and go by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from lavt.value import value


@value
class CanFrame:
    """A CAN data frame; its length (DLC) is that of `data`, 0 to 8 bytes."""

    identifier: int
    data: bytes
    is_extended: bool = False


@value
class ReceivedCanFrame:
    """A frame that came from the bus, and when (this host's monotonic clock)."""

    frame: CanFrame
    arrived_ns: int


class BusGone(Exception):
    """The bus cannot be written to or read from; the text says why."""


class BusPort(Protocol):
    """One side's access to a bus."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted."""
        ...

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        """Send frames that were made at a time, in order, without waiting; raises `BusGone`."""
        ...

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Take what has come since the last call, in order; own frames are not among it. Raises `BusGone`."""
        ...

    def next_wake_ns(self) -> int | None:
        """When `take` has something at the latest; None: nobody knows."""
        ...

    def close(self) -> None:
        """Let go of the bus."""
        ...
