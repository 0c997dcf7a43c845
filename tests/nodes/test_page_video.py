from __future__ import annotations

from lavt.nodes.page_video import MAX_UNACKNOWLEDGED, PageVideo
from lavt.nodes.payloads import ReceivedUnit


def unit(number: int, *, keyframe: bool = False, complete: bool = True) -> ReceivedUnit:
    return ReceivedUnit(b"unit", number, complete, keyframe, 0)


def test_a_page_begins_with_a_keyframe() -> None:
    """Nothing is sent before the first keyframe; then every access unit is."""
    video = PageVideo()
    assert [video.offer(unit(1)), video.offer(unit(2, keyframe=True)), video.offer(unit(3))] == [False, True, True]
    assert video.counts["page_units_skipped"] == 1


def test_a_page_that_does_not_answer_gets_few_units() -> None:
    """With three unacknowledged access units nothing more is sent, not even a keyframe."""
    video = PageVideo()
    sent = [video.offer(unit(number, keyframe=number % 10 == 0)) for number in range(100)]
    assert sum(sent) == MAX_UNACKNOWLEDGED == 3
    assert not video.needs_keyframe


def test_after_a_stall_the_video_continues_with_a_keyframe() -> None:
    """After the acknowledgement, access units that refer to skipped ones are not sent, but the next keyframe is."""
    video = PageVideo()
    for number in range(5):
        video.offer(unit(number, keyframe=number == 0))
    assert video.acknowledge(2)
    assert video.needs_keyframe
    assert [video.offer(unit(6)), video.offer(unit(7, keyframe=True)), video.offer(unit(8))] == [False, True, True]


def test_an_acknowledgement_covers_earlier_units() -> None:
    """An acknowledgement of an access unit acknowledges all earlier ones; another one is counted."""
    video = PageVideo()
    for number in range(3):
        video.offer(unit(number, keyframe=number == 0))
    assert video.acknowledge(1)
    assert not video.acknowledge(0)
    assert not video.acknowledge(77)
    assert video.counts["page_acks_unknown"] == 2
    assert video.offer(unit(3))


def test_incomplete_units_are_not_sent() -> None:
    """An incomplete access unit is skipped, and so are the ones that refer to it."""
    video = PageVideo()
    video.offer(unit(0, keyframe=True))
    assert not video.offer(unit(1, complete=False))
    assert not video.offer(unit(2))
    assert video.needs_keyframe


def test_a_lost_picture_is_followed_by_a_keyframe() -> None:
    """A page that cannot decode gets the next keyframe, and what it has not acknowledged is forgotten."""
    video = PageVideo()
    for number in range(3):
        video.offer(unit(number, keyframe=number == 0))
    video.lose()
    assert video.needs_keyframe
    assert video.offer(unit(9, keyframe=True))
