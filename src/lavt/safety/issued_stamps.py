"""The frame stamps that the server issued recently, and detection of a frozen camera."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple


class _IssuedFrame(NamedTuple):
    number: int
    issued_ns: int
    captured_ns: int


class IssuedStamps:
    """A memory of the issued stamps, each with its frame number, time of issue and capture time.

    Times are on the server's monotonic clock. Frame numbers tell which of two frames is newer. Stamps do not, because
    they are times of the wall clock, which can be stepped.
    """

    def __init__(self, memory_ns: int, frozen_frames: int) -> None:
        self._memory_ns = memory_ns
        self._frozen_frames = frozen_frames
        self._issued: dict[int, _IssuedFrame] = {}
        """The frames by stamp."""
        self._order: deque[tuple[int, int]] = deque()
        """Time of issue and stamp of each frame, oldest first."""
        self._last_crc: int | None = None
        self._last_captured_ns = 0
        self._equal_frames = 0
        """Number of the last frames in a row that have equal pixels."""

    def add(self, stamp_ns: int, number: int, mono_ns: int, pixel_crc: int, captured_ns: int | None = None) -> None:
        """Store the stamp of a frame that was stamped at `mono_ns`; forget stamps older than the memory.

        `pixel_crc` is a checksum of the pixels without the stamp. `captured_ns` is the capture time that the camera
        reports, or None. If it is None or later than `mono_ns`, `mono_ns` is stored as the capture time. For a frame
        whose pixels equal those of the previous frame, the capture time of the previous frame is stored.
        """
        if pixel_crc == self._last_crc:
            self._equal_frames += 1
        else:
            self._equal_frames = 1
            self._last_captured_ns = mono_ns if captured_ns is None else min(captured_ns, mono_ns)
        self._last_crc = pixel_crc
        self._issued[stamp_ns] = _IssuedFrame(number, mono_ns, self._last_captured_ns)
        self._order.append((mono_ns, stamp_ns))
        while self._order:
            oldest_issued_ns, oldest_stamp_ns = self._order[0]
            if oldest_issued_ns >= mono_ns - self._memory_ns:
                break
            self._order.popleft()
            oldest_frame = self._issued.get(oldest_stamp_ns)
            # The same stamp can have been issued again later, after a step of the wall clock.
            if oldest_frame is not None and oldest_frame.issued_ns == oldest_issued_ns:
                del self._issued[oldest_stamp_ns]

    def issued_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """Return when `stamp_ns` was issued; None if this server did not issue it in the time of its memory."""
        frame = self._issued.get(stamp_ns)
        return frame.issued_ns if frame is not None and now_ns - frame.issued_ns <= self._memory_ns else None

    def captured_ns(self, stamp_ns: int) -> int:
        """Return the capture time of the frame with a known stamp."""
        return self._issued[stamp_ns].captured_ns

    def frame_number(self, stamp_ns: int) -> int:
        """Return the frame number of a known stamp."""
        return self._issued[stamp_ns].number

    @property
    def is_frozen(self) -> bool:
        """Return whether the last `frozen_frames` frames had equal pixels."""
        return self._equal_frames >= self._frozen_frames
