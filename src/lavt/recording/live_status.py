"""The live status of a running side: its newest values and the ending of its drive, from the entries of its record."""

from __future__ import annotations

from collections import deque
from typing import Any

from lavt.domain import NS_PER_MS, Now, State
from lavt.runtime.recorder import decode_for_record

MAX_PENDING = 4096
"""At most this many entries, and this many updates, are kept until they are read: enough for more than ten seconds."""

StatusUpdate = tuple[State | str, Now]
"""(content, time): the content is a state of the vehicle, or the reason for which a command was rejected."""


class LiveStatus:
    """A recorder that keeps the newest values for display, even if the record cannot be written.

    `write` is called by the threads of the runtime and only stores the entry; the other methods process the stored
    entries, and are for one thread.

    The one-way latencies are raw: the receiver's wall clock time minus the sender's, without a correction for the clock
    offset.
    """

    def __init__(self) -> None:
        self._ending: str | None = None
        self._status: dict[str, Any] = {}
        self._updates: deque[StatusUpdate] = deque(maxlen=MAX_PENDING)
        self._entries: deque[tuple[str, Any, Now]] = deque(maxlen=MAX_PENDING)
        self._processors = {
            "truth": self._update_truth,
            "admission": self._update_admission,
            "event": self._update_ending,
            "lane": self._update_lane,
            "picture": self._update_picture,
            "state": self._update_state,
        }

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Store one entry, if the live status depends on its topic."""
        if topic in self._processors:
            self._entries.append((topic, payload, now))

    def ending(self) -> str | None:
        """Return how the last drive ended; None before its end, and again after the start of another drive."""
        self._process_entries()
        return self._ending

    def take_updates(self) -> list[StatusUpdate]:
        """Return the states and rejections since the last call, in order."""
        self._process_entries()
        updates = list(self._updates)
        self._updates.clear()
        return updates

    def status(self) -> dict[str, Any]:
        """Return a copy of the newest values, by name."""
        self._process_entries()
        return dict(self._status)

    def _process_entries(self) -> None:
        while self._entries:
            topic, payload, now = self._entries.popleft()
            self._processors[topic](decode_for_record(topic, payload), now)

    def _update_truth(self, truth: Any, _now: Now) -> None:
        self._status.update(cross_track_m=truth.cross_track_m, progress_m=truth.progress_m)

    def _update_state(self, state: Any, now: Now) -> None:
        if isinstance(state, State):
            self._status.update(
                speed_mps=state.speed_mps,
                safety=state.safety,
                reason=state.reason,
                active_operator=state.active_operator,
                requested_by=state.requested_by,
                limited=state.limited,
            )
            if state.rejected:
                self._status["rejected"] = state.rejected
            self._updates.append((state, now))

    def _update_admission(self, admission: Any, now: Now) -> None:
        if admission.verdict == "accepted":  # a rejected command can come from a stranger and have a false send time
            self._status["raw_tau_c_ms"] = (admission.received_wall_ns - admission.sent_wall_ns) / NS_PER_MS
        if admission.reason:
            self._status["rejected"] = admission.reason
            self._updates.append((admission.reason, now))

    def _update_picture(self, picture: Any, _now: Now) -> None:
        if picture.readable:
            self._status["raw_tau_v_ms"] = (picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS

    def _update_lane(self, seen: Any, _now: Now) -> None:
        self._status["lane_confidence"] = seen.lane.confidence

    def _update_ending(self, event: Any, _now: Now) -> None:
        if event.kind == "ending":
            self._ending = event.detail
        elif event.kind == "drive_began":
            self._ending = None
