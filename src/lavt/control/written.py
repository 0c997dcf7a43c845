"""The stamps that the server wrote lately: what a command may refer to, and whether the pictures live."""

from __future__ import annotations

from collections import deque


class WrittenStamps:
    """Remembers each stamp with its frame number and the time it was written, on the server's monotonic clock.

    Newer means a higher frame number: the stamps are times of the wall clock, which may be stepped.
    """

    def __init__(self, memory_ns: int, frozen_frames: int) -> None:
        self._memory_ns = memory_ns
        self._frozen_frames = frozen_frames
        self._written: dict[int, tuple[int, int]] = {}
        self._order: deque[tuple[int, int]] = deque()
        self._last_crc: int | None = None
        self._equal_frames = 0

    def note(self, stamp_ns: int, number: int, mono_ns: int, pixel_crc: int) -> None:
        """A frame was stamped at `mono_ns`; `pixel_crc` is a checksum of its pixels without the stamp."""
        self._equal_frames = self._equal_frames + 1 if pixel_crc == self._last_crc else 1
        self._last_crc = pixel_crc
        self._written[stamp_ns] = (number, mono_ns)
        self._order.append((mono_ns, stamp_ns))
        while self._order and self._order[0][0] < mono_ns - self._memory_ns:
            old_ns, old_stamp_ns = self._order.popleft()
            if self._written.get(old_stamp_ns, (0, old_ns))[1] == old_ns:  # else it was written again since
                self._written.pop(old_stamp_ns, None)

    def mono_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """When `stamp_ns` was written, or None where this server did not write it within its memory."""
        entry = self._written.get(stamp_ns)
        return entry[1] if entry is not None and now_ns - entry[1] <= self._memory_ns else None

    def number(self, stamp_ns: int) -> int:
        """Frame number of a stamp that was written."""
        return self._written[stamp_ns][0]

    @property
    def frozen(self) -> bool:
        """Whether the last pictures were all equal."""
        return self._equal_frames >= self._frozen_frames
