"""The page in which a participant answers the questions at the end of a block, served like the page of the drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec
from msgspec import Meta, Struct

from lavt.assembly.entropy import MachineEntropy
from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.errors import BadMessage, UserError
from lavt.experiment.study.answers import SCALES, STEP, Store, raw_tlx
from lavt.node import Send
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.console.console_link import ConsoleLink

PAGE_FILES: Final = Path(__file__).parent / "page"
TOKEN_BYTES: Final = 16
MAX_COMMENT_CHARACTERS: Final = 1000
MAX_MESSAGE_BYTES: Final = 8192
"""The answers are smaller: the page counts UTF-16 units, each of which takes at most 6 bytes."""
THANKS_S: Final = 2.0
"""How long the page may take to show that its answers are stored."""


class PageAnswers(Struct, frozen=True, tag="answers", forbid_unknown_fields=True):
    """The answers that a page sends."""

    scales: dict[str, int]
    comment: Annotated[str, Meta(max_length=MAX_COMMENT_CHARACTERS)]


class _ToPage(Struct, frozen=True):
    """A message to the page. `notice` is shown; the questions are pairs of name and text."""

    type: Literal["questions", "rejected", "thanks"]
    notice: str = ""
    title: str = ""
    questions: Sequence[tuple[str, str]] = ()
    step: int = STEP


class _FromLink(NamedTuple):
    """A message of the link: a page was opened, has sent a payload, or was closed."""

    channel: str
    payload: Any
    page: Any


THANKS: Final = _ToPage("thanks", "Thank you, your answers are stored. Close this page.")


def ask_in_page(title: str, port: int, show: Callable[[str], None], store: Store) -> None:
    """Serve the page of the questions at `port` (0: any), `show` its address, and `store` the answers.

    The first valid answers count, from whichever page; the page learns of it when they are stored. Raises `UserError`
    if the port cannot be opened.
    """
    arrived: SimpleQueue[_FromLink | BaseException] = SimpleQueue()
    token = MachineEntropy().token(TOKEN_BYTES).hex()
    link = ConsoleLink(MachineClock(), token, port, folder=PAGE_FILES, max_message_bytes=MAX_MESSAGE_BYTES)
    with fail_on_thread_errors(arrived.put):
        link.start(lambda channel, payload, _now, page: arrived.put(_FromLink(channel, payload, page)))
        try:
            show(link.url)
            page, answers = _first_answers(title, link, arrived)
            store(answers.scales, " ".join(answers.comment.split()))
            _send(link, page, THANKS)
            _wait_until_closed(page, arrived)
        finally:
            link.close()


def _first_answers(
    title: str, link: ConsoleLink, arrived: SimpleQueue[_FromLink | BaseException]
) -> tuple[Any, PageAnswers]:
    """Send the questions to each page; return the first valid answers, and the page that has sent them."""
    while True:
        message = arrived.get()
        if isinstance(message, BaseException):
            raise message
        if message.channel == "page_opened":
            _send(link, message.page, _ToPage("questions", title=title, questions=tuple(SCALES.items())))
        elif message.channel == "page_message":
            try:
                return message.page, parse_answers(message.payload)
            except (BadMessage, UserError) as error:
                _send(link, message.page, _ToPage("rejected", f"The answers were not accepted: {error}."))


def parse_answers(data: str | bytes) -> PageAnswers:
    """Return the answers in a message; raise `BadMessage` for another message, `UserError` for wrong scales."""
    try:
        answers = msgspec.json.decode(data, type=PageAnswers)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise BadMessage(f"not a message of the page of the questions: {error}") from error
    raw_tlx(answers.scales)
    return answers


def _send(link: ConsoleLink, page: Any, message: _ToPage) -> None:
    link.send(Send("page_status", msgspec.json.encode(message), page))


def _wait_until_closed(page: Any, arrived: SimpleQueue[_FromLink | BaseException]) -> None:
    """Wait until the page has closed its connection, but no longer than `THANKS_S`."""
    clock = MachineClock()
    end_ns = clock.now().mono_ns + round(THANKS_S * NS_PER_S)
    with suppress(Empty):
        while (left_ns := end_ns - clock.now().mono_ns) > 0:
            message = arrived.get(timeout=left_ns / NS_PER_S)
            if isinstance(message, BaseException) or (message.channel, message.page) == ("page_closed", page):
                return
