from __future__ import annotations

from typing import Any

from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US
from lavt.nodes.payloads import DecodedFrame, FrameStamp, PagePicture
from lavt.nodes.shown_frames import MAX_FRAMES, ShownFrames
from lavt.transport.console.page_messages import PageShown
from lavt.transport.video.stamp import rtp_timestamp

STAMP_NS = 1_700_000_000 * NS_PER_S
NO_PICTURE: Any = None


def frame(number: int) -> DecodedFrame:
    stamp_ns = STAMP_NS + number * 40 * NS_PER_MS
    return DecodedFrame(stamp_ns, stamp_ns + NS_PER_MS, NO_PICTURE)


def shown(stamp_ns: int) -> PageShown:
    """Return what a page reports that has read this stamp from the picture 0; its clock is 10 us behind."""
    return PageShown(rtp_timestamp(STAMP_NS), str(stamp_ns), 1, 2, 3, 4, offset_us=10.0, bound_us=5.0)


def test_a_frame_is_shown_when_it_is_decoded_too() -> None:
    """The page can show a picture before or after this client has decoded it; a newer one replaces one awaited."""
    frames, first, second = ShownFrames(), frame(0), frame(1)
    assert frames.show(rtp_timestamp(first.stamp_ns)) is None
    assert frames.note_decoded(first) == FrameStamp(first.stamp_ns, first.read_wall_ns)
    assert frames.note_decoded(second) is None
    assert frames.show(rtp_timestamp(second.stamp_ns)) == FrameStamp(second.stamp_ns, second.read_wall_ns)
    frames.show(rtp_timestamp(frame(2).stamp_ns))
    frames.forget_awaited()
    assert frames.note_decoded(frame(2)) is None


def test_old_frames_are_forgotten() -> None:
    """Only the newest `MAX_FRAMES` frames can still be shown."""
    frames = ShownFrames()
    for number in range(MAX_FRAMES + 1):
        frames.note_decoded(frame(number))
    assert frames.show(rtp_timestamp(frame(0).stamp_ns)) is None
    assert frames.show(rtp_timestamp(frame(1).stamp_ns)) is not None


def test_times_are_those_of_a_true_stamp() -> None:
    """The page's times are converted to this client's clock, unless the page has read another stamp; both count."""
    frames = ShownFrames()
    assert frames.times(shown(STAMP_NS)) is None
    frames.note_decoded(frame(0))
    arrived_ns, decoded_ns, drawn_ns, shown_ns = ((10 + time_us) * NS_PER_US for time_us in (1, 2, 3, 4))
    expected = PagePicture(STAMP_NS, arrived_ns, decoded_ns, drawn_ns, shown_ns, 5 * NS_PER_US)
    assert frames.times(shown(STAMP_NS)) == expected
    assert frames.times(shown(STAMP_NS + 1)) is None
    assert frames.counts == {"page_stamps_true": 1, "page_stamps_false": 1}
