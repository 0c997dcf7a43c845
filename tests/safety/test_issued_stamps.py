from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S
from lavt.safety.issued_stamps import IssuedStamps

MEMORY_NS = 5 * NS_PER_S


def test_a_stamp_is_known_by_number_and_time() -> None:
    """A stamp that was written is known with its frame number and the monotonic time of its writing; others are not."""
    written = IssuedStamps(MEMORY_NS, 5)
    written.note(777, 3, 100, 1)
    assert written.mono_ns(777, 200) == 100
    assert written.number(777) == 3
    assert written.mono_ns(778, 200) is None


@pytest.mark.parametrize(("age_ns", "known"), [(MEMORY_NS, True), (MEMORY_NS + 1, False)])
def test_memory_ends_exactly(age_ns: int, *, known: bool) -> None:
    """A stamp is known for the memory's length and not a nanosecond longer, whether or not others were written."""
    for others in (False, True):
        written = IssuedStamps(MEMORY_NS, 5)
        written.note(777, 3, 100, 1)
        if others:
            written.note(778, 4, 100 + age_ns, 2)
        assert (written.mono_ns(777, 100 + age_ns) is not None) == known


def test_a_stamp_written_twice_counts_as_the_newer_frame() -> None:
    """When a stepped clock writes a stamp again, the stamp lives as long as its newer frame."""
    written = IssuedStamps(MEMORY_NS, 5)
    written.note(777, 1, 0, 1)
    written.note(777, 9, 3 * NS_PER_S, 2)
    written.note(778, 10, MEMORY_NS + 1, 3)  # forgets the first writing
    assert written.mono_ns(777, MEMORY_NS + 1) == 3 * NS_PER_S
    assert written.number(777) == 9


def test_a_picture_was_taken_when_the_camera_says_so() -> None:
    """The time of taking is the camera's, or that of writing where it has none, or that of the first of equal ones."""
    written = IssuedStamps(MEMORY_NS, 5)
    for stamp_ns, mono_ns, crc, captured_ns in ((1, 100, 7, 90), (2, 200, 8, None), (3, 300, 8, 290), (4, 400, 9, 390)):
        written.note(stamp_ns, stamp_ns, mono_ns, crc, captured_ns)
    assert [written.captured_ns(stamp_ns) for stamp_ns in (1, 2, 3, 4)] == [90, 200, 200, 390]


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, NS_PER_S)), max_size=60))
def test_memory_does_not_grow(frames: list[tuple[int, int]]) -> None:
    """Whatever the stamps, only those of the last 5 s are kept, and each of them is known."""
    written = IssuedStamps(MEMORY_NS, 5)
    now_ns, last = 0, {}
    for number, (stamp_ns, passed_ns) in enumerate(frames):
        now_ns += passed_ns
        written.note(stamp_ns, number, now_ns, number)
        last[stamp_ns] = (number, now_ns, now_ns)
    alive = {stamp_ns: each for stamp_ns, each in last.items() if now_ns - each[1] <= MEMORY_NS}
    assert written._written == alive
    assert all(written.mono_ns(stamp_ns, now_ns) == at_ns for stamp_ns, (_, at_ns, _) in alive.items())


def test_frozen_is_five_equal_pictures_in_a_row() -> None:
    """Five equal pictures in a row are frozen, a different one ends it, and alternating ones never are."""
    written = IssuedStamps(MEMORY_NS, 5)
    frozen = []
    for number, crc in enumerate([7, 7, 7, 7, 7, 7, 8, 8, 7, 8, 7, 8, 7]):
        written.note(number, number, number, crc)
        frozen.append(written.frozen)
    assert frozen == [False] * 4 + [True] * 2 + [False] * 7
