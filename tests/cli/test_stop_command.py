from __future__ import annotations

import queue
from dataclasses import replace

import pytest

from lavt.cli import stop
from lavt.cli.session_log import NO_STATE_YET
from lavt.domain import SessionReply, SessionRequest
from lavt.errors import WorkError
from lavt.node import Send
from lavt.transport.messages import encode

REQUEST = SessionRequest("emergency_stop", "alice", 1, 60)
STOPPED = SessionReply(True, "", 0, b"", 5600, "kernel", 60)
OLD = SessionReply(False, "the number of this emergency stop is not a new one", 0, b"", 5600, "kernel", 59)


def test_a_stop_is_requested_for_until_its_own_number_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost queries, garbage and answers to the number before do not end it; that the vehicle knows the number does."""
    monkeypatch.setattr(stop, "AGAIN_S", 0.0)
    known = replace(OLD, emergency_stop=60)
    for answer in (STOPPED, known):
        answers: list[bytes | None] = [None, b"garbage", encode(OLD), None, encode(answer)]
        replies, requested = queue.Queue[bytes](), list[Send]()

        def send(*sends: Send, answers: list[bytes | None] = answers, requested: list[Send] = requested,
                 replies: queue.Queue[bytes] = replies) -> None:  # fmt: skip
            requested.extend(sends)
            come = answers[len(requested) - 1]
            if come is not None:
                replies.put(come)

        assert stop._ask(send, replies, REQUEST) == answer
        assert requested == [Send("session", encode(REQUEST))] * 5
        assert stop._stops(answer, 60)
    assert not stop._stops(OLD, 58)


def test_who_gets_no_answer_is_told_of_the_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where keys do not fit neither side hears the other; the operator is told so, by `lavt stop` and by the client."""
    monkeypatch.setattr(stop, "AGAIN_S", 0.0)
    with pytest.raises(WorkError, match="`lavt doctor CONFIG`"):
        stop._ask(lambda *_: None, queue.Queue(), REQUEST)
    assert "`lavt doctor CONFIG`" in NO_STATE_YET
