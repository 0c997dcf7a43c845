"""Who looks at a stream and does not drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lavt.domain import Now
from lavt.node import Hop, Message
from lavt.nodes.picture_reader import PictureReader


class WatcherNode:
    """Reads pictures in the driver's place, and makes nothing of them: what became of each is in "picture"."""

    name = "driver"
    """Under which the channels know who gets pictures."""

    def __init__(self, reader: PictureReader) -> None:
        self.counts: Mapping[str, int] = reader.counts
        self.chains: Mapping[str, Sequence[Hop]] = {"access_unit": reader.stages, "view": (("forget", _forget),)}

    def next_wake_ns(self) -> None:
        """It sleeps until a picture comes."""


def _forget(_message: Message, _now: Now) -> None:
    """Drop a picture that nobody looks at."""
