"""Clocks for tests, with known or chosen times."""

from __future__ import annotations

from lavt.clock import MachineClock
from lavt.domain import NS_PER_MS, Now


class ManualClock:
    """A clock that advances when the test says so, and by `step_ns` at each reading."""

    def __init__(self, mono_ns: int = 0, *, wall_ahead_ns: int = 0, step_ns: int = 0) -> None:
        self.mono_ns, self.wall_ahead_ns, self.step_ns = mono_ns, wall_ahead_ns, step_ns

    def now(self) -> Now:
        """Return both clocks; the wall clock is `wall_ahead_ns` ahead of the monotonic one."""
        self.mono_ns += self.step_ns
        return Now(self.mono_ns, self.mono_ns + self.wall_ahead_ns)

    def advance(self, duration_ms: float) -> None:
        """Advance both clocks."""
        self.mono_ns += round(duration_ms * NS_PER_MS)


class ShiftedClock:
    """This machine's clocks, ahead by `mono_ns` and `wall_ns`; the wall clock gains `wall_step_ns` at each reading."""

    def __init__(self, *, mono_ns: int = 0, wall_ns: int = 0, wall_step_ns: int = 0) -> None:
        self._mono_ns, self._wall_ns, self._wall_step_ns = mono_ns, wall_ns, wall_step_ns

    def now(self) -> Now:
        """Return both clocks."""
        now = MachineClock().now()
        self._wall_ns += self._wall_step_ns
        return Now(now.mono_ns + self._mono_ns, now.wall_ns + self._wall_ns)
