"""Clocks of which a test knows or decides what they show."""

from __future__ import annotations

from lavt.clock import MachineClock
from lavt.domain import NS_PER_MS, Now


class ManualClock:
    """A clock that moves when the test moves it, and by `step_ns` at each reading."""

    def __init__(self, mono_ns: int = 0, *, wall_ahead_ns: int = 0, step_ns: int = 0) -> None:
        self.mono_ns, self.wall_ahead_ns, self.step_ns = mono_ns, wall_ahead_ns, step_ns

    def now(self) -> Now:
        """Read both clocks; the wall clock is always `wall_ahead_ns` ahead."""
        self.mono_ns += self.step_ns
        return Now(self.mono_ns, self.mono_ns + self.wall_ahead_ns)

    def advance(self, duration_ms: float) -> None:
        """Move both clocks forward."""
        self.mono_ns += round(duration_ms * NS_PER_MS)


class ShiftedClock:
    """This machine's clocks, both shifted; the wall clock by `wall_step_ns` more at each reading."""

    def __init__(self, *, mono_ns: int = 0, wall_ns: int = 0, wall_step_ns: int = 0) -> None:
        self._mono_ns, self._wall_ns, self._wall_step_ns = mono_ns, wall_ns, wall_step_ns

    def now(self) -> Now:
        """Read both clocks."""
        now = MachineClock().now()
        self._wall_ns += self._wall_step_ns
        return Now(now.mono_ns + self._mono_ns, now.wall_ns + self._wall_ns)
