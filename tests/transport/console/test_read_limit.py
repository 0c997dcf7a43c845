from __future__ import annotations

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.console.read_limit import (
    FIRST_READS,
    MAX_READS,
    MAX_STRANGER_READS,
    READS_PER_S,
    ReadLimits,
    RefillingLimit,
)

PAGE_HZ = 2 * (50 + 2 * 60 + 2)
"""Frames and reads of a page at 60 Hz: 50 inputs, two messages for each picture, two probes; a read for each."""


def taken(limits: ReadLimits, now_ns: int) -> int:
    """Return how many reads of the connection "page" are within its limit at this time."""
    number = 0
    while limits.take("page", now_ns):
        number += 1
    return number


def test_a_limit_refills() -> None:
    """A limit that is used up allows again what the time since then allows, and never more than it can save up."""
    limit = RefillingLimit(10, 20, 3)
    assert [limit.take(0) for _ in range(4)] == [True] * 3 + [False]
    assert [limit.take(200 * NS_PER_MS) for _ in range(3)] == [True] * 2 + [False]
    assert [limit.take(100 * NS_PER_S) for _ in range(21)] == [True] * 20 + [False]


def test_a_limit_that_is_asked_often_refills() -> None:
    """Events above the limit do not delay its refill."""
    limit = RefillingLimit(1, 1, 0)
    assert not any(limit.take(now_ns) for now_ns in range(0, NS_PER_S - NS_PER_MS, NS_PER_MS))
    assert limit.take(NS_PER_S)


def test_a_stranger_can_send_little() -> None:
    """A connection without the token has a small limit, which never refills."""
    limits = ReadLimits()
    limits.add("page")
    assert taken(limits, 0) == MAX_STRANGER_READS
    assert taken(limits, 100 * NS_PER_S) == 0


def test_a_new_page_can_send_less_than_an_old_one() -> None:
    """A page that connects again gains nothing; one that stays connected saves up reads."""
    limits = ReadLimits()
    limits.add("page")
    limits.admit("page")
    assert taken(limits, 0) == FIRST_READS
    assert taken(limits, NS_PER_S) == READS_PER_S
    assert taken(limits, 100 * NS_PER_S) == MAX_READS


def test_a_connection_that_has_ended_can_send_nothing() -> None:
    """After its end, nothing of a connection is processed, even if it shows the token."""
    limits = ReadLimits()
    limits.add("page")
    limits.remove("page")
    limits.admit("page")
    assert taken(limits, 0) == 0


def test_a_page_stays_below_the_limit() -> None:
    """A page that sends what it does at 60 Hz is never limited, also if it sends a second's messages at once."""
    assert PAGE_HZ <= READS_PER_S
    assert PAGE_HZ <= MAX_READS - READS_PER_S
    assert PAGE_HZ // 2 <= FIRST_READS  # the frames, if they arrive in one read
