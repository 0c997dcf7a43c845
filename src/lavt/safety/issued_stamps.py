"""The stamps that the server wrote lately: what a command may refer to, and whether the pictures live."""

from __future__ import annotations

from collections import deque


class IssuedStamps:
    """Remembers each stamp with its frame number, when it was written, and when its picture was taken.

    Times are of the server's monotonic clock.

    Newer means a higher frame number: the stamps are times of the wall clock, which may be stepped.
    """

    def __init__(self, memory_ns: int, frozen_frames: int) -> None:
        self._memory_ns = memory_ns
        self._frozen_frames = frozen_frames
        self._written: dict[int, tuple[int, int, int]] = {}
        self._order: deque[tuple[int, int]] = deque()
        self._last_crc: int | None = None
        self._last_captured_ns = 0
        self._equal_frames = 0

    def note(self, stamp_ns: int, number: int, mono_ns: int, pixel_crc: int, captured_ns: int | None = None) -> None:
        """A frame was stamped at `mono_ns`; `pixel_crc` is a checksum of its pixels without the stamp.

        `captured_ns` is when the camera says that it took the picture. One that equals the picture before it was taken
        when that was.
        """
        if pixel_crc == self._last_crc:
            self._equal_frames += 1
        else:
            self._equal_frames = 1
            self._last_captured_ns = mono_ns if captured_ns is None else captured_ns
        self._last_crc = pixel_crc
        self._written[stamp_ns] = (number, mono_ns, self._last_captured_ns)
        self._order.append((mono_ns, stamp_ns))
        while self._order and self._order[0][0] < mono_ns - self._memory_ns:
            old_ns, old_stamp_ns = self._order.popleft()
            if self._written.get(old_stamp_ns, (0, old_ns, 0))[1] == old_ns:  # else it was written again since
                self._written.pop(old_stamp_ns, None)

    def mono_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """When `stamp_ns` was written, or None where this server did not write it within its memory."""
        entry = self._written.get(stamp_ns)
        return entry[1] if entry is not None and now_ns - entry[1] <= self._memory_ns else None

    def captured_ns(self, stamp_ns: int) -> int:
        """When the picture of a stamp that was written was taken, as far as the camera knows."""
        return self._written[stamp_ns][2]

    def number(self, stamp_ns: int) -> int:
        """Frame number of a stamp that was written."""
        return self._written[stamp_ns][0]

    @property
    def frozen(self) -> bool:
        """Whether the last pictures were all equal."""
        return self._equal_frames >= self._frozen_frames
