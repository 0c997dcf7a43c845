from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S
from lavt.safety.issued_stamps import IssuedStamps

MEMORY_NS = 5 * NS_PER_S


def test_an_issued_stamp_is_known() -> None:
    """An issued stamp is known with its frame number and time of issue; other stamps are unknown."""
    stamps = IssuedStamps(MEMORY_NS, 5)
    stamps.add(777, 3, 100, 1)
    assert stamps.issued_ns(777, 200) == 100
    assert stamps.frame_number(777) == 3
    assert stamps.issued_ns(778, 200) is None


@pytest.mark.parametrize(("age_ns", "known"), [(MEMORY_NS, True), (MEMORY_NS + 1, False)])
def test_a_stamp_expires_exactly(age_ns: int, *, known: bool) -> None:
    """A stamp is known for 5 s after its issue and no nanosecond longer, whether or not another stamp is issued."""
    for is_another_issued in (False, True):
        stamps = IssuedStamps(MEMORY_NS, 5)
        stamps.add(777, 3, 100, 1)
        if is_another_issued:
            stamps.add(778, 4, 100 + age_ns, 2)
        assert (stamps.issued_ns(777, 100 + age_ns) is not None) == known


def test_a_stamp_issued_twice_belongs_to_the_newer_frame() -> None:
    """A stamp that is issued twice, after a step of the clock, belongs to the newer frame and expires with it."""
    stamps = IssuedStamps(MEMORY_NS, 5)
    stamps.add(777, 1, 0, 1)
    stamps.add(777, 9, 3 * NS_PER_S, 2)
    stamps.add(778, 10, MEMORY_NS + 1, 3)  # forgets the first issue
    assert stamps.issued_ns(777, MEMORY_NS + 1) == 3 * NS_PER_S
    assert stamps.frame_number(777) == 9


def test_capture_time() -> None:
    """The capture time is the camera's, but never later than the issue; equal pictures have the first one's.

    If the camera reports no capture time, the time of issue is used.
    """
    stamps = IssuedStamps(MEMORY_NS, 5)
    # Stamp, time of issue, checksum, capture time.
    added = ((1, 100, 7, 90), (2, 200, 8, None), (3, 300, 8, 290), (4, 400, 9, 390), (5, 500, 10, 501))
    for stamp_ns, mono_ns, crc, captured_ns in added:
        stamps.add(stamp_ns, stamp_ns, mono_ns, crc, captured_ns)
    assert [stamps.captured_ns(stamp_ns) for stamp_ns in (1, 2, 3, 4, 5)] == [90, 200, 200, 390, 500]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, MEMORY_NS)), max_size=60))
def test_only_the_last_5_s_are_kept(frames: list[tuple[int, int]]) -> None:
    """For any sequence of stamps, exactly those of the last 5 s are kept and known."""
    stamps = IssuedStamps(MEMORY_NS, 5)
    now_ns, last = 0, {}
    for number, (stamp_ns, passed_ns) in enumerate(frames):
        now_ns += passed_ns
        stamps.add(stamp_ns, number, now_ns, number)
        last[stamp_ns] = (number, now_ns, now_ns)
    alive = {
        stamp_ns: (number, issued_ns, captured_ns)
        for stamp_ns, (number, issued_ns, captured_ns) in last.items()
        if now_ns - issued_ns <= MEMORY_NS
    }
    assert stamps._issued == alive
    assert all(stamps.issued_ns(stamp_ns, now_ns) == at_ns for stamp_ns, (_, at_ns, _) in alive.items())


def test_five_equal_pictures_are_frozen() -> None:
    """From the fifth equal picture in a row until a different one, pictures are frozen; alternating ones never are."""
    stamps = IssuedStamps(MEMORY_NS, 5)
    frozen = []
    for number, crc in enumerate([7, 7, 7, 7, 7, 7, 8, 8, 7, 8, 7, 8, 7]):
        stamps.add(number, number, number, crc)
        frozen.append(stamps.is_frozen)
    assert frozen == [False] * 4 + [True] * 2 + [False] * 7
