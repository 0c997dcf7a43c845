from __future__ import annotations

import json

from lavt.domain import NS_PER_S
from lavt.transport.console.message_limit import (
    MAX_MESSAGES_PER_S,
    MAX_STOPS_PER_S,
    MessageLimit,
)

STOP = json.dumps({"type": "stop"})


def filled() -> MessageLimit:
    """Return a limit that is used up for the second 0."""
    limit = MessageLimit()
    assert all(limit.allows("input", 0) for _ in range(MAX_MESSAGES_PER_S))
    return limit


def test_messages_above_the_limit_are_dropped_until_the_next_second() -> None:
    """Above the limit of a second, messages are dropped; in the next second they are delivered again."""
    limit = filled()
    assert not limit.allows("input", NS_PER_S - 1)
    assert limit.allows("input", NS_PER_S)


def test_stops_have_a_limit_of_their_own() -> None:
    """Emergency stops above the limit are delivered, but no flood of them is."""
    limit = filled()
    assert [limit.allows(STOP, 1) for _ in range(MAX_STOPS_PER_S + 1)] == [True] * MAX_STOPS_PER_S + [False]
