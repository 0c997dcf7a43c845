from __future__ import annotations

import json

from lavt.domain import NS_PER_S
from lavt.transport.console.message_limit import (
    MAX_DROPPED_PER_S,
    MAX_MESSAGES_PER_S,
    MAX_STOPS_PER_S,
    MessageLimit,
    Verdict,
)

STOP = json.dumps({"type": "stop"})


def filled() -> MessageLimit:
    """Return a limit that is used up for the second 0."""
    limit = MessageLimit()
    assert {limit.judge("input", 0) for _ in range(MAX_MESSAGES_PER_S)} == {Verdict.DELIVER}
    return limit


def test_messages_above_the_limit_are_dropped_until_the_next_second() -> None:
    """Above the limit of a second, messages are dropped; in the next second they are delivered again."""
    limit = filled()
    assert limit.judge("input", NS_PER_S - 1) is Verdict.DROP
    assert limit.judge("input", NS_PER_S) is Verdict.DELIVER


def test_stops_have_a_limit_of_their_own() -> None:
    """Emergency stops above the limit are delivered, but no flood of them is."""
    limit = filled()
    assert [limit.judge(STOP, 1) for _ in range(MAX_STOPS_PER_S + 1)] == [Verdict.DELIVER] * MAX_STOPS_PER_S + [
        Verdict.DROP
    ]


def test_a_flood_closes_the_page() -> None:
    """A page that sends far more than the limit is closed."""
    limit = filled()
    assert {limit.judge("input", 1) for _ in range(MAX_DROPPED_PER_S)} == {Verdict.DROP}
    assert limit.judge("input", 1) is Verdict.CLOSE
