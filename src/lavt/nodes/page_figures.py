"""Figures that a page shows about the running drive: bit rate and round trip of the commands."""

from __future__ import annotations

from collections import deque
from typing import Final

from lavt.domain import NS_PER_S

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
