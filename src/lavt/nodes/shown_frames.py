"""Which of the frames that this client has decoded the page shows, and when the page had them."""

from __future__ import annotations

from collections import Counter
from typing import Final

from lavt.domain import NS_PER_US
from lavt.nodes.payloads import DecodedFrame, FrameStamp, PagePicture
from lavt.transport.console.page_messages import PageShown
from lavt.transport.video.stamp import rtp_timestamp

MAX_FRAMES: Final = 300
"""How many frames are remembered until the page has shown them: ten seconds at 30 Hz."""


class ShownFrames:
    """The frames that this client has decoded, by the RTP timestamps of their access units, and which one is shown.

    A page can show a picture before this client has decoded it.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._frames: dict[int, FrameStamp] = {}
        self._awaited_unit: int | None = None
        """The newest access unit that the driving page has shown, if it has not been decoded here yet."""

    def note_decoded(self, frame: DecodedFrame) -> FrameStamp | None:
        """Note a decoded frame, and return it if the driving page already shows it."""
        unit = rtp_timestamp(frame.stamp_ns)  # `PictureReader` has checked that they agree
        if len(self._frames) >= MAX_FRAMES:
            self._frames.pop(next(iter(self._frames)))
        self._frames[unit] = FrameStamp(frame.stamp_ns, frame.read_wall_ns)
        return self.show(unit) if unit == self._awaited_unit else None

    def show(self, unit: int) -> FrameStamp | None:
        """Return the frame of an access unit that the driving page shows; None: it must be decoded here first."""
        frame = self._frames.get(unit)
        self._awaited_unit = unit if frame is None else None
        return frame

    def forget_awaited(self) -> None:
        """Wait for no frame any more: another page drives."""
        self._awaited_unit = None

    def times(self, shown: PageShown) -> PagePicture | None:
        """Return when the driving page had a picture, on this client's wall clock; None: the stamps do not agree."""
        frame = self._frames.get(shown.unit)
        if frame is None:
            return None
        is_true = int(shown.stamp) == frame.stamp_ns
        self.counts["page_stamps_true" if is_true else "page_stamps_false"] += 1
        if not is_true:
            return None
        page_times_us = (shown.arrived_us, shown.decoded_us, shown.drawn_us, shown.shown_us)
        offset_ns = round(shown.offset_us * NS_PER_US)
        arrived_ns, decoded_ns, drawn_ns, shown_ns = (time_us * NS_PER_US + offset_ns for time_us in page_times_us)
        bound_ns = round(shown.bound_us * NS_PER_US)
        return PagePicture(frame.stamp_ns, arrived_ns, decoded_ns, drawn_ns, shown_ns, bound_ns)
