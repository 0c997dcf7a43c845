"""What a running side can tell of itself while it records: the newest figures, and when a drive ends."""

from __future__ import annotations

import threading
from typing import Any

from lavt.domain import NS_PER_MS, Now
from lavt.runtime.recording import Recorder


class LiveTap:
    """A recorder that passes everything on and keeps the newest of what a person wants to see.

    The one-way latencies are raw: receiver's wall clock less sender's. Whoever shows them must know the offset.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.ending: str | None = None
        self._recorder = recorder
        self._lock = threading.Lock()
        self._status: dict[str, Any] = {}

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry."""
        self._recorder.write(topic, payload, now)
        look = {"truth": self._truth, "admission": self._admission, "event": self._event, "picture": self._picture,
                "state": self._state}.get(topic)  # fmt: skip
        if look is not None:
            with self._lock:
                look(payload, now)

    def status(self) -> dict[str, Any]:
        """Copy the newest figures."""
        with self._lock:
            return dict(self._status)

    def _truth(self, truth: Any, _now: Now) -> None:
        self._status.update(cross_track_m=truth.cross_track_m, progress_m=truth.progress_m)

    def _state(self, state: Any, _now: Now) -> None:
        if hasattr(state, "safety"):
            self._status.update(speed_mps=state.speed_mps, safety=state.safety, because=state.because)

    def _admission(self, admission: Any, _now: Now) -> None:
        self._status["raw_tau_c_ms"] = (admission.received_wall_ns - admission.sent_wall_ns) / NS_PER_MS
        if admission.reason:
            self._status["refused"] = admission.reason

    def _picture(self, picture: Any, _now: Now) -> None:
        if picture.readable:
            self._status["raw_tau_v_ms"] = (picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS

    def _event(self, event: Any, _now: Now) -> None:
        if event.kind == "ending":
            self.ending = event.detail
        elif event.kind == "drive_began":
            self.ending = None
