"""Figures that a page shows about the running drive: bit rate, round trip of the commands, state of the vehicle."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

from msgspec import UNSET

from lavt.domain import NS_PER_S, State

MAX_UNITS: Final = 300
"""How many access units are remembered for the bit rate: more than a second at any frame rate."""
MAX_COMMANDS: Final = 512
"""How many commands are remembered until the vehicle has applied them: five seconds."""


class BitRate:
    """The bit rate of the access units that arrived in the last second."""

    def __init__(self) -> None:
        self._arrived: deque[tuple[int, int]] = deque(maxlen=MAX_UNITS)
        """Times and sizes (bytes)."""

    def note(self, size_bytes: int, now_ns: int) -> None:
        """Note an access unit that arrived now."""
        self._arrived.append((now_ns, size_bytes))

    def at_bps(self, now_ns: int) -> int:
        """Return the bit rate now."""
        while self._arrived and self._arrived[0][0] < now_ns - NS_PER_S:
            self._arrived.popleft()
        return 8 * sum(size for _, size in self._arrived)


class RoundTrip:
    """The time from sending a command to the arrival of the first state in which the vehicle reports it as applied."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        """None: no command was applied yet."""
        self._sent: deque[tuple[int, int]] = deque(maxlen=MAX_COMMANDS)
        """Sequence numbers and send times of commands that the vehicle has not applied yet."""

    def note_command(self, sequence: int, now_ns: int) -> None:
        """Note a command that is sent now."""
        self._sent.append((sequence, now_ns))

    def note_applied(self, sequence: int, now_ns: int) -> None:
        """Note the last applied command of a state that arrived now."""
        while self._sent and self._sent[0][0] <= sequence:
            oldest, sent_ns = self._sent.popleft()
            if oldest == sequence:
                self.newest_ns = now_ns - sent_ns


def vehicle_figures(state: State | None, *, shows_latency: bool) -> dict[str, Any]:
    """Return the fields of a `PageStatus` that are those of the vehicle's newest state; None: there is no state yet.

    Without `shows_latency`, the reason of the speed limit is left out, because it can be the latency.
    """
    names = ("safety", "reason", "active_operator", "requested_by", "rejected", "limited")
    figures: dict[str, Any] = {name: getattr(state, name, "") for name in names}
    if state is not None and state.speed_limit_mps is not UNSET and state.speed_limit_reason is not UNSET:
        figures["speed_limit_mps"] = state.speed_limit_mps
        figures["speed_limit_reason"] = state.speed_limit_reason if shows_latency else ""
    return figures
