"""The flow control of the video to one page: at most a few access units are on the way, so that none is old."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final

from lavt.nodes.payloads import ReceivedUnit

MAX_UNACKNOWLEDGED: Final = 3
"""With this many unacknowledged access units, the page gets no more until the next keyframe. Without this limit the
kernel's buffers hide that a page has stalled, and it shows the old pictures afterwards, one by one."""


class PageVideo:
    """The access units that a page was sent and has not acknowledged: at most `limit`. It begins with a keyframe."""

    def __init__(self, limit: int = MAX_UNACKNOWLEDGED) -> None:
        self.counts: Counter[str] = Counter()
        self._limit = limit
        self._waits_for_keyframe = True
        self._unacknowledged: deque[int] = deque()
        """RTP timestamps, oldest first."""

    @property
    def needs_keyframe(self) -> bool:
        """Return whether a keyframe would be sent, and nothing else."""
        return self._waits_for_keyframe and len(self._unacknowledged) < self._limit

    def offer(self, unit: ReceivedUnit) -> bool:
        """Return whether to send this access unit now; after one that is not sent, only a keyframe is."""
        is_room = len(self._unacknowledged) < self._limit
        is_decodable = unit.complete and (unit.keyframe or not self._waits_for_keyframe)
        if not (is_room and is_decodable):
            self._waits_for_keyframe = True
            self.counts["page_units_skipped"] += 1
            return False
        self._waits_for_keyframe = False
        self._unacknowledged.append(unit.rtp_timestamp)
        return True

    def acknowledge(self, rtp_timestamp: int) -> bool:
        """Remove an access unit and all earlier ones; return whether it was on the way."""
        if rtp_timestamp not in self._unacknowledged:
            self.counts["page_acks_unknown"] += 1
            return False
        while self._unacknowledged.popleft() != rtp_timestamp:
            pass
        return True

    def lose(self) -> None:
        """Send nothing until the next keyframe: the page cannot decode what is on the way."""
        self._waits_for_keyframe = True
        self._unacknowledged.clear()
