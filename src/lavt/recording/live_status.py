"""What a running side can tell of itself while it records: the newest figures, and when a drive ends."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

from lavt.domain import NS_PER_MS, Now, State
from lavt.runtime.recorder import Recorder

KEPT = 4096
"""Of what nobody has taken yet, the newest: more than ten seconds of states and commands."""

Heard = tuple[State | str, Now]
"""A state of the vehicle, or why a command was refused, and when."""


class LiveTap:
    """A recorder that passes everything on and keeps the newest of what a person wants to see.

    The one-way latencies are raw: receiver's wall clock less sender's. Whoever shows them must know the offset.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.ending: str | None = None
        self._recorder = recorder
        self._lock = threading.Lock()
        self._status: dict[str, Any] = {}
        self._heard: deque[Heard] = deque(maxlen=KEPT)

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry."""
        self._recorder.write(topic, payload, now)
        look = {"truth": self._truth, "admission": self._admission, "event": self._event, "picture": self._picture,
                "state": self._state}.get(topic)  # fmt: skip
        if look is not None:
            with self._lock:
                look(payload, now)

    def take_updates(self) -> list[Heard]:
        """Take the states and refusals since the last call, in order."""
        with self._lock:
            heard = list(self._heard)
            self._heard.clear()
        return heard

    def status(self) -> dict[str, Any]:
        """Copy the newest figures."""
        with self._lock:
            return dict(self._status)

    def _truth(self, truth: Any, _now: Now) -> None:
        self._status.update(cross_track_m=truth.cross_track_m, progress_m=truth.progress_m)

    def _state(self, state: Any, now: Now) -> None:
        if isinstance(state, State):
            self._status.update(
                speed_mps=state.speed_mps, safety=state.safety, reason=state.reason,
                active_operator=state.active_operator, requested_by=state.requested_by, limited=state.limited,
            )  # fmt: skip
            if state.rejected:
                self._status["rejected"] = state.rejected
            self._heard.append((state, now))

    def _admission(self, admission: Any, now: Now) -> None:
        self._status["raw_tau_c_ms"] = (admission.received_wall_ns - admission.sent_wall_ns) / NS_PER_MS
        if admission.reason:
            self._status["rejected"] = admission.reason
            self._heard.append((admission.reason, now))

    def _picture(self, picture: Any, _now: Now) -> None:
        if picture.readable:
            self._status["raw_tau_v_ms"] = (picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS

    def _event(self, event: Any, _now: Now) -> None:
        if event.kind == "ending":
            self.ending = event.detail
        elif event.kind == "drive_began":
            self.ending = None
