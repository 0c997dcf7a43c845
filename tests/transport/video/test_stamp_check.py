"""Test the check of a foreign sender's stamps; its RTP timestamps begin at an unknown value, the base."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.streams import stream
from lavt.transport.video.stamp import rtp_timestamp
from lavt.transport.video.stamp_check import JUMP_NS, LEARNED_AFTER, RELEARN_AFTER_NS, TOLERANCE_NS, LearnedBase

START_NS = 1_760_000_000_123_456_789
FRAME_NS = NS_PER_S // 30
TIMESTAMPS = st.integers(min_value=0, max_value=2**32 - 1)
STAMPS = st.integers(min_value=0, max_value=2**64 - 1)


def sent_pairs(
    count: int, base: int = 0, begin_ns: int = START_NS, jitter_ns: int = 0, drift: float = 0.0
) -> list[tuple[int, int]]:
    """Return stamps and RTP timestamps of a sender that stamps each picture up to `jitter_ns` after its capture."""
    late_ns = stream(1, "stamped late").integers(0, jitter_ns + 1, count).tolist()
    captured_ns = [begin_ns + number * FRAME_NS for number in range(count)]
    timestamps = [(base + round((ns - begin_ns) * (1 + drift) * 9 / 100_000)) % 2**32 for ns in captured_ns]
    return [(ns + late, timestamp) for ns, late, timestamp in zip(captured_ns, late_ns, timestamps, strict=True)]


def learned_check(base: int = 0) -> tuple[LearnedBase, int, int]:
    """Return a check that has learned the base, the last stamp it accepted and its timestamp."""
    check = LearnedBase()
    pairs = sent_pairs(LEARNED_AFTER, base)
    assert [check.agrees(*pair) for pair in pairs] == [False] * (LEARNED_AFTER - 1) + [True]
    return check, *pairs[-1]


@given(TIMESTAMPS)
def test_every_stamp_of_a_steady_sender_is_accepted(base: int) -> None:
    """All stamps are accepted from the fifth one on, for any base and across the wrap of 2^32."""
    check = LearnedBase()
    accepted = [check.agrees(*pair) for pair in sent_pairs(300, base, jitter_ns=4 * NS_PER_MS)]
    assert accepted == [False] * (LEARNED_AFTER - 1) + [True] * (301 - LEARNED_AFTER)


def test_the_wrap_of_the_timestamps() -> None:
    """Stamps are accepted across the wrap of the timestamps."""
    check, stamp_ns, _ = learned_check(2**32 - LEARNED_AFTER * 3000)
    assert check.agrees(stamp_ns + FRAME_NS, 0)
    assert check.agrees(stamp_ns + 2 * FRAME_NS, 3000)


@given(STAMPS, TIMESTAMPS)
def test_garbage(stamp_ns: int, timestamp: int) -> None:
    """After learning, a stamp is accepted only if it is newer than the last and within 5 ms of its timestamp's time."""
    check, last_ns, last_timestamp = learned_check(77)
    difference = (timestamp - last_timestamp + 2**31) % 2**32 - 2**31
    expected_ns = last_ns + difference * 100_000 // 9
    near = abs(stamp_ns - expected_ns) <= TOLERANCE_NS and stamp_ns > last_ns
    assert check.agrees(stamp_ns, timestamp) == near


@given(
    st.integers(min_value=1, max_value=RELEARN_AFTER_NS // 2), st.integers(min_value=-12_000_000, max_value=12_000_000)
)
def test_near_the_expected_time(ahead_ns: int, off_ns: int) -> None:
    """After a gap of any length, a stamp is accepted only if it is within 5 ms of its timestamp's time."""
    check, last_ns, last_timestamp = learned_check(77)
    timestamp = (last_timestamp + ahead_ns * 9 // 100_000) % 2**32
    stamp_ns = last_ns + ahead_ns + off_ns
    expected_ns = last_ns + ahead_ns * 9 // 100_000 * 100_000 // 9
    assert check.agrees(stamp_ns, timestamp) == (abs(stamp_ns - expected_ns) <= TOLERANCE_NS and stamp_ns > last_ns)


def test_random_stamps() -> None:
    """Of 100 000 random 64-bit stamps with a valid timestamp none is accepted."""
    check, _, last_timestamp = learned_check()
    stamps = stream(1, "garbage").integers(0, 2**64, 100_000, dtype=np.uint64).tolist()
    assert not any(check.agrees(stamp, (last_timestamp + 3000) % 2**32) for stamp in stamps)


def test_stale_pictures() -> None:
    """A stamp that was accepted before, and the stamp of the previous frame, are not accepted again."""
    check = LearnedBase()
    pairs = sent_pairs(200, 99, jitter_ns=3 * NS_PER_MS)
    for stamp_ns, timestamp in pairs[:50]:
        check.agrees(stamp_ns, timestamp)
    assert not check.agrees(*pairs[49])
    for (before_ns, _), (_, timestamp) in pairwise(pairs[49:]):
        assert not check.agrees(before_ns, timestamp)
        assert not check.agrees(pairs[49][0], timestamp)


def test_a_frozen_picture_is_not_learned() -> None:
    """No base is learned from one stamp that is repeated."""
    check = LearnedBase()
    assert not any(check.agrees(START_NS, number * 3000) for number in range(1000))


def test_learning_among_garbage() -> None:
    """The base is learned although every third stamp is garbage, and no garbage is accepted."""
    check = LearnedBase()
    garbage = stream(1, "garbage").integers(0, 2**64, 60, dtype=np.uint64).tolist()
    accepted = []
    for number, (stamp_ns, timestamp) in enumerate(sent_pairs(60, 5, jitter_ns=4 * NS_PER_MS)):
        if number % 3 == 0:
            assert not check.agrees(garbage[number], timestamp)
        else:
            accepted.append(check.agrees(stamp_ns, timestamp))
    assert accepted.index(True) < 20
    assert all(accepted[20:])


def test_jitter_beyond_the_tolerance() -> None:
    """No base is learned from stamps with a jitter of tens of milliseconds."""
    check = LearnedBase()
    pairs = [
        (stamp_ns + (number % 3) * 40 * NS_PER_MS, timestamp)
        for number, (stamp_ns, timestamp) in enumerate(sent_pairs(300))
    ]
    assert not any(check.agrees(*pair) for pair in pairs)


@pytest.mark.parametrize("drift", [100e-6, -100e-6])
def test_drift(drift: float) -> None:
    """Timestamps that drift by 100 ppm are followed indefinitely: here by 36 ms in six minutes."""
    check = LearnedBase()
    accepted = [check.agrees(*pair) for pair in sent_pairs(10_800, 7, jitter_ns=4 * NS_PER_MS, drift=drift)]
    assert all(accepted[LEARNED_AFTER - 1 :])


def test_a_sender_that_restarts() -> None:
    """After a restart with another base, stamps are accepted from the fifth on, and none that fits the old base."""
    check, last_ns, last_timestamp = learned_check(1000)
    later_ns = last_ns + 2 * NS_PER_S
    pairs = sent_pairs(20, 3_000_000_000, later_ns)
    assert [check.agrees(*pair) for pair in pairs] == [False] * (LEARNED_AFTER - 1) + [True] * (21 - LEARNED_AFTER)
    assert not check.agrees(later_ns + NS_PER_S, last_timestamp + rtp_timestamp(3 * NS_PER_S))


def test_a_sender_that_paused() -> None:
    """After a pause of more than a minute in which the clocks diverged, the base is learned again from five stamps."""
    check, last_ns, last_timestamp = learned_check(1000)
    begin_ns = last_ns + JUMP_NS + NS_PER_S
    new_base = last_timestamp + rtp_timestamp(JUMP_NS + NS_PER_S + 2 * TOLERANCE_NS)
    accepted = [check.agrees(*pair) for pair in sent_pairs(10, new_base, begin_ns)]
    assert accepted == [False] * (LEARNED_AFTER - 1) + [True] * (11 - LEARNED_AFTER)


def test_a_wrong_high_bit_that_stays() -> None:
    """Stamps with the same wrong bit, which agree with each other but not with the base, are rejected for 12 s."""
    check, _, _ = learned_check(1000)
    frames = RELEARN_AFTER_NS // FRAME_NS
    pairs = sent_pairs(frames + 100, 1000)[LEARNED_AFTER:]
    wrong = [check.agrees(stamp_ns ^ 1 << 45, timestamp) for stamp_ns, timestamp in pairs[: frames - 1]]
    assert not any(wrong)
    assert all(check.agrees(*pair) for pair in pairs[frames - 1 : frames + 50])


def test_a_step_of_the_senders_clock() -> None:
    """After a step of the sender's clock, forward or back, its stamps are accepted again after 12 s."""
    for step_ns in (3600 * NS_PER_S, -3600 * NS_PER_S):
        check, _, _ = learned_check(1000)
        pairs = sent_pairs(RELEARN_AFTER_NS // FRAME_NS + 60, 1000)[LEARNED_AFTER:]
        accepted = [check.agrees(stamp_ns + step_ns, timestamp) for stamp_ns, timestamp in pairs]
        first = accepted.index(True)
        assert 0 <= pairs[first][0] - pairs[0][0] - RELEARN_AFTER_NS < FRAME_NS
        assert all(accepted[first:])


@given(st.lists(st.tuples(STAMPS, TIMESTAMPS), max_size=30))
def test_any_stamps(pairs: list[tuple[int, int]]) -> None:
    """Arbitrary stamps and timestamps raise nothing, and no stamp before the fifth is accepted."""
    check = LearnedBase()
    accepted = [number for number, pair in enumerate(pairs) if check.agrees(*pair)]
    assert all(number >= LEARNED_AFTER - 1 for number in accepted)
