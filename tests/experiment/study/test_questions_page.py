"""The page of the questions after a block, as a client of the package `websockets` sees it."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import pytest
from tests.support.clocks import ManualClock
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lavt.clock import pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import BadMessage, UserError
from lavt.experiment.study import questions_page
from lavt.experiment.study.answers import SCALES
from lavt.experiment.study.questions_page import MAX_COMMENT_CHARACTERS, PAGE_FILES, ask_in_page, parse_answers
from lavt.transport.console.page_messages import PAGE_VERSION

SCALES_OF_ANSWER = dict(zip(SCALES, range(0, 30, 5), strict=True))


class Participant:
    """A participant whose pages are opened by the test, and who is asked in a thread of its own."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        """The stored answers: scales and comment."""
        self.error: BaseException | None = None
        self.store_error: Exception | None = None
        """Raised when answers are to be stored."""
        urls: queue.Queue[str] = queue.Queue()
        self._pages = ExitStack()
        self._thread = threading.Thread(target=self._ask, args=(urls.put,), daemon=True)
        self._thread.start()
        self._site, _, self._token = urls.get(timeout=10).partition("/#")

    def _ask(self, show: Callable[[str], None]) -> None:
        try:
            ask_in_page("Block 1", 0, show, self._store)
        except OSError as error:
            self.error = error

    def _store(self, scales: Mapping[str, int], comment: str) -> None:
        if self.store_error is not None:
            raise self.store_error
        self.answers.append((scales, comment))

    def open(self) -> tuple[ClientConnection, dict[str, Any]]:
        """Open a page; return its connection and the questions."""
        uri = f"{self._site}/socket".replace("http:", "ws:")
        origin: Any = self._site
        connection = connect(uri, origin=origin, compression=None, proxy=None, close_timeout=1)
        page = self._pages.enter_context(connection)
        page.send(json.dumps({"type": "hello", "version": PAGE_VERSION, "token": self._token}))
        return page, receive(page)

    def wait(self) -> None:
        """Wait until the answers have been returned, and close all pages."""
        self._thread.join(10)
        assert not self._thread.is_alive()
        self._pages.close()


def receive(page: ClientConnection) -> dict[str, Any]:
    message: dict[str, Any] = json.loads(page.recv(timeout=10))
    return message


def send_often(page: ClientConnection) -> None:
    """Send a message every 10 ms for 4 s."""
    for _ in range(400):
        page.send("x")
        pause(10 * NS_PER_MS)


def answers(**changes: Any) -> str:
    return json.dumps({"type": "answers", "scales": SCALES_OF_ANSWER, "comment": "", **changes})


@pytest.fixture
def participant() -> Iterator[Participant]:
    participant = Participant()
    yield participant
    if not participant.answers and participant.error is None:
        page, _ = participant.open()
        page.send(answers())
        page.close()
    participant.wait()


def test_the_page_asks_and_returns_the_answers(participant: Participant) -> None:
    """A page gets title and questions; wrong answers are rejected, and the first valid ones count, with the comment."""
    participant.open()
    page, asked = participant.open()
    assert (asked["type"], asked["title"]) == ("questions", "Block 1")
    assert asked["questions"] == [list(question) for question in SCALES.items()]
    page.send(answers(scales={**SCALES_OF_ANSWER, "effort": 12}))
    rejected = receive(page)
    assert (rejected["type"], "effort" in rejected["notice"]) == ("rejected", True)
    page.send(answers(comment=" It was\nlate. "))
    assert receive(page)["type"] == "thanks"
    assert participant.answers == [(SCALES_OF_ANSWER, "It was late.")], "the answers were stored before"
    page.close()
    participant.wait()
    assert len(participant.answers) == 1


def test_answers_that_cannot_be_stored_get_no_thanks(participant: Participant) -> None:
    """If the answers cannot be stored, the page is closed without thanks, and the error is raised."""
    participant.store_error = OSError("the disk is full")
    page, _ = participant.open()
    page.send(answers())
    with pytest.raises(ConnectionClosed):
        page.recv(timeout=10)
    participant.wait()
    assert participant.error is participant.store_error


def test_a_page_that_stays_open_does_not_delay_the_end(
    participant: Participant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the thanks, neither the page nor messages of other pages make the wait longer."""
    monkeypatch.setattr(questions_page, "MachineClock", lambda: ManualClock(step_ns=NS_PER_S // 2))
    other, _ = participant.open()
    page, _ = participant.open()
    page.send(answers())
    assert receive(page)["type"] == "thanks"
    with pytest.raises(ConnectionClosed):
        send_often(other)
    participant.wait()


def test_the_longest_comment_is_accepted(participant: Participant) -> None:
    """A comment of the greatest length arrives whole, even if JSON escapes every character."""
    page, _ = participant.open()
    comment = "\x01" * MAX_COMMENT_CHARACTERS
    page.send(answers(comment=comment))
    assert receive(page)["type"] == "thanks"
    page.close()
    participant.wait()
    assert participant.answers == [(SCALES_OF_ANSWER, comment)]


@pytest.mark.parametrize(
    "data",
    [
        "",
        "[]",
        '{"type": "answers"}',
        b"\xff",
        answers(comment="x" * (MAX_COMMENT_CHARACTERS + 1)),
        answers(comment=None),
        answers(scales={}),
        answers(scales={**SCALES_OF_ANSWER, "other": 5}),
        answers(scales={**SCALES_OF_ANSWER, "effort": True}),
        answers(scales={**SCALES_OF_ANSWER, "effort": 105}),
        answers(condition="L0"),
        answers(comment="x").replace("x", "\\ud800"),
    ],
)
def test_other_messages_are_rejected(data: str | bytes) -> None:
    """A message that is no answers, has other scales, or numbers or texts out of range, is rejected."""
    with pytest.raises((BadMessage, UserError)):
        parse_answers(data)


def test_the_page_sends_the_version_of_the_messages() -> None:
    """The version of the page's messages is that of this program."""
    assert f"const VERSION = {PAGE_VERSION};" in (PAGE_FILES / "questions.js").read_text()
