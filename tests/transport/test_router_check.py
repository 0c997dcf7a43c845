"""The check of the router in this process, with real routers and peers that answer in its place."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import pytest
import zenoh
from tests.support.ports import free_port

from lavt.errors import WorkError
from lavt.transport.router_check import MAX_REPORTS, MAX_UNANSWERED, RouterCheck, parse_locators, parse_routers
from lavt.transport.zenoh_session import quiet_logs, router_reports

ANSWERS = (b"\xff", b"[not json", b"[1]", b"7", b"null", b"{}", b'{"zid": 1, "version": 2, "sessions": [3]}', b"")
"""Answers of a peer to a query for a router's report."""


def open_session(mode: str, **settings: str) -> zenoh.Session:
    config = zenoh.Config()
    values = {"mode": f'"{mode}"', "scouting/multicast/enabled": "false", "adminspace/enabled": "true", **settings}
    for key, value in values.items():
        config.insert_json5(key, value)
    return zenoh.open(config)


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """Yield a router with a peer that answers every query for a report, first with bytes that are no text."""
    quiet_logs()
    endpoints = f'["tcp/127.0.0.1:{free_port()}"]'
    with ExitStack() as stack:
        router = stack.enter_context(open_session("router", **{"listen/endpoints": endpoints}))
        peer = stack.enter_context(open_session("client", **{"connect/endpoints": endpoints}))

        def answer(query: Any) -> None:
            for payload in ANSWERS:
                query.reply(query.key_expr, payload)

        own_key = f"@/{router.info.zid()}/router"
        declared = [peer.declare_queryable(key, answer) for key in (own_key, "@/strange/router")]
        yield router
        for queryable in declared:
            queryable.undeclare()


def test_answers_of_strangers_do_no_harm(session: zenoh.Session) -> None:
    """Whatever a peer answers, the check passes, and the endpoints and links are those that the router reports."""
    check = RouterCheck(partial(router_reports, session))
    for _ in range(MAX_UNANSWERED + 1):
        check.run()
    assert not check.has_failed
    (locator,) = parse_locators(router_reports(session))
    assert locator.startswith("tcp/127.0.0.1:")
    routers = parse_routers(router_reports(session, "@/*/router"), {str(session.info.zid())})
    assert routers is not None
    assert (routers.linked, len(routers.versions)) == (0, 1)


def test_answers_without_end_are_not_all_read(session: zenoh.Session) -> None:
    """Of the answers of a peer that answers very often, only `MAX_REPORTS` are read."""

    def answer(query: zenoh.Query) -> None:
        for _ in range(4 * MAX_REPORTS):
            query.reply(query.key_expr, b"x")

    queryable: Any = session.declare_queryable("@/strange/router", answer)
    assert len(router_reports(session, "@/strange/router")) == MAX_REPORTS
    queryable.undeclare()


def test_a_router_that_does_not_answer_for_several_times_has_failed() -> None:
    """The check fails at the last of `MAX_UNANSWERED` queries in a row without an answer, and not before."""
    answers: list[bytes] = []
    check = RouterCheck(lambda: answers)
    for answer in ([], [], [b""], [], []):
        answers[:] = answer
        check.run()
    with pytest.raises(WorkError, match="has failed"):
        check.run()
    assert check.has_failed


def test_a_closed_session_has_failed() -> None:
    """An error of Zenoh fails the check at once; if the link is being closed, it only ends the check."""
    quiet_logs()
    session = open_session("router", **{"listen/endpoints": "[]"})
    session.close()
    closing = threading.Event()
    with pytest.raises(WorkError, match="has failed"):
        RouterCheck(partial(router_reports, session)).repeat(closing)
    closing.set()
    RouterCheck(partial(router_reports, session)).repeat(closing)
