"""The watcher node, which decodes a video stream and does not drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lavt.domain import Now
from lavt.node import Message, Stage
from lavt.nodes.picture_reader import PictureReader


class WatcherNode:
    """A node in the driver's place, which reads pictures and drops them; the channel "picture" records each outcome."""

    name = "driver"
    """Not "watcher", because pictures are sent to the node of this name (`channels.py`)."""

    def __init__(self, reader: PictureReader) -> None:
        self.counts: Mapping[str, int] = reader.counts
        self.pipelines: Mapping[str, Sequence[Stage]] = {"access_unit": reader.stages, "view": (("forget", _forget),)}

    def next_wake_ns(self) -> None:
        """Return None: only messages wake the node."""


def _forget(_message: Message, _now: Now) -> None:
    """Drop a picture."""
