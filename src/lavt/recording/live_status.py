"""The live status of a running side, taken from its record: the newest figures, and the ending of a drive."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

from lavt.domain import NS_PER_MS, Now, State
from lavt.runtime.recorder import Recorder

MAX_PENDING = 4096
"""Updates that are kept until they are taken: the newest, more than ten seconds of states and commands."""

StatusUpdate = tuple[State | str, Now]
"""A state of the vehicle or the reason for which a command was rejected, and its time."""


class LiveTap:
    """A recorder that passes everything on and keeps the newest figures for display.

    The one-way latencies are raw: receiver's wall clock minus sender's, without a correction for the clock offset.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.ending: str | None = None
        self._recorder = recorder
        self._lock = threading.Lock()
        self._status: dict[str, Any] = {}
        self._updates: deque[StatusUpdate] = deque(maxlen=MAX_PENDING)

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry, and update the status with it."""
        self._recorder.write(topic, payload, now)
        update = {
            "truth": self._update_truth,
            "admission": self._update_admission,
            "event": self._update_ending,
            "picture": self._update_picture,
            "state": self._update_state,
        }.get(topic)
        if update is not None:
            with self._lock:
                update(payload, now)

    def take_updates(self) -> list[StatusUpdate]:
        """Return the states and rejections since the last call, in order."""
        with self._lock:
            updates = list(self._updates)
            self._updates.clear()
        return updates

    def status(self) -> dict[str, Any]:
        """Return a copy of the newest figures."""
        with self._lock:
            return dict(self._status)

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
        if admission.verdict == "accepted":  # the send time of any other may be a stranger's
            self._status["raw_tau_c_ms"] = (admission.received_wall_ns - admission.sent_wall_ns) / NS_PER_MS
        if admission.reason:
            self._status["rejected"] = admission.reason
            self._updates.append((admission.reason, now))

    def _update_picture(self, picture: Any, _now: Now) -> None:
        if picture.readable:
            self._status["raw_tau_v_ms"] = (picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS

    def _update_ending(self, event: Any, _now: Now) -> None:
        if event.kind == "ending":
            self.ending = event.detail
        elif event.kind == "drive_began":
            self.ending = None
