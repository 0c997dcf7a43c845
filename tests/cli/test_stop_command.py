from __future__ import annotations

import queue

import pytest
from msgspec.structs import replace

from lavt.cli import stop
from lavt.cli.session_log import NO_STATE_YET
from lavt.domain import SessionReply, SessionRequest
from lavt.errors import WorkError
from lavt.node import Send
from lavt.transport.messages import encode

REQUEST = SessionRequest("emergency_stop", "alice", 1, 60)
ACCEPTED = SessionReply(True, "", 0, b"", 5600, "kernel", 60)
EARLIER_NUMBER = SessionReply(False, "the number of this emergency stop is not a new one", 0, b"", 5600, "kernel", 59)


def test_a_stop_is_repeated_until_it_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The query is repeated after lost queries, garbage and replies to an earlier number, until it is answered."""
    monkeypatch.setattr(stop, "RETRY_PERIOD_S", 0.0)
    accepted_before = replace(EARLIER_NUMBER, emergency_stop=60)
    for answer in (ACCEPTED, accepted_before):
        answers: list[bytes | None] = [None, b"garbage", encode(EARLIER_NUMBER), None, encode(answer)]
        replies, queries = queue.Queue[bytes](), list[Send]()

        def send(
            *sends: Send,
            answers: list[bytes | None] = answers,
            queries: list[Send] = queries,
            replies: queue.Queue[bytes] = replies,
        ) -> None:
            queries.extend(sends)
            reply = answers[len(queries) - 1]
            if reply is not None:
                replies.put(reply)

        assert stop._query(send, replies, REQUEST) == answer
        assert queries == [Send("session", encode(REQUEST))] * 5
        assert stop._is_stopped(answer, 60)
    assert not stop._is_stopped(EARLIER_NUMBER, 58)


def test_a_missing_answer_points_to_the_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an answer, `lavt stop` and `lavt client` refer to `lavt doctor`, because the keys may not match."""
    monkeypatch.setattr(stop, "RETRY_PERIOD_S", 0.0)
    with pytest.raises(WorkError, match="`lavt doctor CONFIG`"):
        stop._query(lambda *_: None, queue.Queue(), REQUEST)
    assert "`lavt doctor CONFIG`" in NO_STATE_YET
