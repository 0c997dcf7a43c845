"""The newest ticks of a CARLA world, and the watch over the actuator; threads share both."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.carla.settings import CarlaEvent, Snapshot

REMEMBERED_TICKS: Final = 64
SILENCE_NS: Final = 200 * NS_PER_MS
"""If the actuator has not looked for ticks for this long, the car is braked; it looks every 5 ms."""
FULL_BRAKE: Final = Actuation(0.0, 0.0, 1.0)


class Ticked(Struct, frozen=True):
    """The car after a tick, with the time of this state on the server's monotonic clock."""

    due_ns: int
    snapshot: Snapshot


class TickHistory:
    """The newest ticks with their events. All methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._ticked: deque[Ticked] = deque(maxlen=REMEMBERED_TICKS)
        self._events: list[tuple[int, CarlaEvent]] = []

    def add(self, ticked: Ticked, events: Iterable[CarlaEvent]) -> None:
        """Add a tick, and events, each with the time of the tick of its frame."""
        with self._changed:
            self._ticked.append(ticked)
            due_of_frame = {known.snapshot.frame: known.due_ns for known in self._ticked}
            self._events += [(due_of_frame.get(event.frame, ticked.due_ns), event) for event in events]
            self._changed.notify_all()

    def ticked_at(self, at_ns: int) -> Ticked | None:
        """Return the newest tick that was due by `at_ns`; None if it is forgotten or there was none."""
        with self._lock:
            return next((ticked for ticked in reversed(self._ticked) if ticked.due_ns <= at_ns), None)

    def wait_for_tick(self, after_ns: int, timeout_s: float) -> Ticked | None:
        """Return the newest tick if it was due after `after_ns`, waiting for it; None if none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._ticked) and self._ticked[-1].due_ns > after_ns, timeout_s)
            return self._ticked[-1] if self._ticked and self._ticked[-1].due_ns > after_ns else None

    def wait_for_frame(self, frame: int, timeout_s: float) -> Ticked | None:
        """Return the tick of a frame, waiting for it; None if it did not come in time or is forgotten."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._ticked) and self._ticked[-1].snapshot.frame >= frame, timeout_s)
            return next((ticked for ticked in reversed(self._ticked) if ticked.snapshot.frame == frame), None)

    def take_events(self) -> list[tuple[int, CarlaEvent]]:
        """Return the events since the last call, each with the time of its tick, in order of time."""
        with self._lock:
            events, self._events = self._events, []
        return sorted(events, key=lambda event: event[0])

    def take_ticks(self, after_ns: int) -> list[Ticked]:
        """Return the remembered ticks that were due after `after_ns`."""
        with self._lock:
            return [ticked for ticked in self._ticked if ticked.due_ns > after_ns]


class ActuatorWatch:
    """Notices when the actuator does not look for ticks any more."""

    def __init__(self) -> None:
        self.silences = 0
        """How often the actuator became silent."""
        self._heard_ns: int | None = None
        """When the actuator last looked for ticks; None: it has not yet."""
        self._is_silent = False

    def hear(self, now_ns: int) -> None:
        """Note that the actuator is alive."""
        self._heard_ns = now_ns

    def is_silent(self, now_ns: int) -> bool:
        """Return whether the actuator has not looked for ticks for `SILENCE_NS`."""
        was_silent, heard_ns = self._is_silent, self._heard_ns
        self._is_silent = heard_ns is not None and now_ns - heard_ns > SILENCE_NS
        self.silences += self._is_silent and not was_silent
        return self._is_silent
