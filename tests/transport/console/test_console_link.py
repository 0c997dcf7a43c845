"""The web server of the console, with real sockets and the client of the package `websockets`."""

# ruff: noqa: D102 (a test bench with short methods)

from __future__ import annotations

import http.client
import itertools
import json
import queue
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Close
from websockets.sync.client import ClientConnection, connect

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.console import console_link, message_limit, read_limit
from lavt.transport.console.console_link import MAX_PAGES, ConsoleLink
from lavt.transport.console.listeners import has_ipv6
from lavt.transport.console.page_messages import MAX_PAGE_MESSAGE_BYTES, PAGE_VERSION
from lavt.transport.console.read_limit import (
    CONNECTIONS_PER_S,
    FIRST_READS,
    MAX_OPENINGS,
    MAX_READS,
    MAX_STRANGER_READS,
    RefillingLimit,
)
from lavt.transport.console.site import (
    HEADERS,
    NOT_A_HELLO,
    TOO_MANY_MESSAGES,
    TOO_MANY_OPENINGS,
    TOO_MANY_PAGES,
    WRONG_TOKEN,
    WRONG_VERSION,
)
from lavt.transport.console.strangers import MAX_STRANGER_BYTES, MAX_STRANGERS

TOKEN = "0123456789abcdef"
HELLO = json.dumps({"type": "hello", "version": PAGE_VERSION, "token": TOKEN})
KEY = f"Sec-WebSocket-Key: {'A' * 22}=="
STOP = json.dumps({"type": "stop"})
PING = bytes([0x89, 0x80 | 125, 0, 0, 0, 0]) + bytes(125)
LONG = bytes([0x81, 0x80 | 126, *(1000).to_bytes(2, "big"), 0, 0, 0, 0]) + bytes(1000)
FLOODS = {
    "pings": PING * MAX_READS,
    "empty pings": bytes([0x89, 0x80, 0, 0, 0, 0]) * MAX_READS,
    "pongs": bytes([0x8A, 0x80, 0, 0, 0, 0]) * MAX_READS,
    "fragments": bytes([0x01, 0x80, 0, 0, 0, 0]) + bytes([0x00, 0x80, 0, 0, 0, 0]) * MAX_READS,
    "messages": bytes([0x81, 0x80, 0, 0, 0, 0]) * MAX_READS,
    "long messages": LONG * MAX_READS,
}
"""The bytes of many frames of one kind."""
Delivered = tuple[str, Any, int]


class Console:
    """A running link, and what it has delivered."""

    def __init__(self) -> None:
        self.link = ConsoleLink(MachineClock(), TOKEN)
        self.delivered: queue.Queue[Delivered] = queue.Queue()

        self._connections = ExitStack()

    def deliver(self, channel: str, payload: Any, _arrived: Now, peer: Any) -> None:
        self.delivered.put((channel, payload, peer))

    def take(self) -> Delivered:
        return self.delivered.get(timeout=10)

    def connect(self, *, origin: str | None = None, host: str = "127.0.0.1") -> ClientConnection:
        own: Any = f"http://127.0.0.1:{self.link.port}" if origin is None else origin or None
        uri = f"ws://{host}:{self.link.port}/socket"
        connection = connect(uri, origin=own, compression=None, proxy=None, close_timeout=1)
        opened: ClientConnection = self._connections.enter_context(connection)
        return opened

    def close(self) -> None:
        self.link.close()
        self._connections.close()

    def open(self) -> tuple[ClientConnection, int]:
        """Open a page with the right token, and return its connection and its number."""
        page = self.connect()
        page.send(HELLO)
        channel, _, number = self.take()
        assert channel == "page_opened"
        return page, number

    def closing_code(self, hello: str | bytes) -> int:
        """Return the code with which the socket is closed after this first message."""
        page = self.connect()
        page.send(hello)
        with pytest.raises(ConnectionClosed) as raised:
            page.recv(timeout=10)
        assert raised.value.rcvd is not None
        return raised.value.rcvd.code


@pytest.fixture
def console() -> Iterator[Console]:
    console = Console()
    failures: list[BaseException] = []
    with fail_on_thread_errors(failures.append):
        console.link.start(console.deliver)
        yield console
        console.close()
    assert failures == []


def get(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    result = response.status, dict(response.getheaders()), response.read()
    connection.close()
    return result


def test_the_page_is_served_with_security_headers(console: Console) -> None:
    """The page and its files are served with the headers that bind it to this site; foreign requests are rejected."""
    status, headers, body = get(console.link.port, "/")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b"<canvas" in body
    assert headers.items() >= HEADERS.items()
    assert not [name for name in headers if name.lower().startswith("access-control")]
    assert get(console.link.port, "/main.js")[1]["Content-Type"].startswith("text/javascript")
    assert get(console.link.port, "/", Host="attacker.example")[0] == 421
    assert get(console.link.port, "/", Origin="http://attacker.example")[0] == 403
    assert get(console.link.port, "/../site.py")[0] == 404
    assert console.link.counts == {"requests_answered": 2, "requests_rejected": 3}


@pytest.mark.parametrize("request_line", ["GET /socket HTTP/1.1", f"GET /{'x' * 10000} HTTP/1.1"], ids=["426", "414"])
def test_every_error_has_the_security_headers(console: Console, request_line: str) -> None:
    """Also an answer to a request that is no valid one, or should have opened the socket, binds a page to this site."""
    site = f"127.0.0.1:{console.link.port}"
    with socket.create_connection(("127.0.0.1", console.link.port), timeout=10) as sock:
        sock.sendall(f"{request_line}\r\nHost: {site}\r\nOrigin: http://{site}\r\n\r\n".encode())
        head = sock.recv(65536).partition(b"\r\n\r\n")[0].decode()
    assert head.startswith("HTTP/1.1 4")
    assert f"Content-Security-Policy: {HEADERS['Content-Security-Policy']}" in head


def test_the_answer_to_head_has_no_body(console: Console) -> None:
    """A HEAD request is not allowed, and its answer has headers only."""
    with socket.create_connection(("127.0.0.1", console.link.port), timeout=10) as sock:
        sock.sendall(f"HEAD / HTTP/1.1\r\nHost: 127.0.0.1:{console.link.port}\r\n\r\n".encode())
        answer = b"".join(iter(lambda: sock.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 405 ")
    assert answer.endswith(b"\r\n\r\n")


@pytest.mark.parametrize("origin", ["http://attacker.example", "null", ""])
def test_a_foreign_page_cannot_open_the_socket(console: Console, origin: str) -> None:
    """A WebSocket with a foreign, null or missing Origin is rejected with 403, whatever token it knows."""
    with pytest.raises(InvalidStatus) as raised:
        console.connect(origin=origin)
    assert raised.value.response.status_code == 403


def test_a_foreign_name_cannot_open_the_socket(console: Console) -> None:
    """A WebSocket to a foreign host name that leads to this machine is rejected with 421."""
    uri = f"ws://attacker.example:{console.link.port}/socket"
    with socket.create_connection(("127.0.0.1", console.link.port)) as sock, pytest.raises(InvalidStatus) as raised:
        connect(uri, sock=sock, compression=None, proxy=None)
    assert raised.value.response.status_code == 421


def test_the_server_listens_on_loopback_addresses_only(console: Console) -> None:
    """The server answers at 127.0.0.1 and, if this machine has it, at ::1, and listens at no other address."""
    addresses = {listener.getsockname()[0] for listener in console.link._sockets}
    assert addresses <= {"127.0.0.1", "::1"}
    assert ("::1" in addresses) == has_ipv6()
    if "::1" in addresses:
        page = console.connect(host="[::1]", origin=f"http://[::1]:{console.link.port}")
        page.send(HELLO)
        assert console.take()[0] == "page_opened"


@pytest.mark.parametrize(
    ("hello", "code"),
    [
        (json.dumps({"type": "hello", "version": PAGE_VERSION, "token": "wrong"}), WRONG_TOKEN.code),
        (json.dumps({"type": "hello", "version": 0, "token": TOKEN}), WRONG_VERSION.code),
        ('{"type": "stop"}', NOT_A_HELLO.code),
        (b"\xff\xfe\x00", NOT_A_HELLO.code),
        ("x" * (MAX_PAGE_MESSAGE_BYTES + 1), 1009),
    ],
)
def test_without_the_token_nothing_is_delivered(console: Console, hello: str | bytes, code: int) -> None:
    """A page whose first message is not a hello with the token is closed, and nothing of it is delivered."""
    assert console.closing_code(hello) == code
    assert console.delivered.empty()


def test_messages_of_a_page_are_delivered(console: Console) -> None:
    """After the hello, messages are delivered as they are, and the end of the connection is."""
    page, number = console.open()
    page.send("any text")
    page.send(b"\xff\x00")
    assert [console.take(), console.take()] == [
        ("page_message", "any text", number),
        ("page_message", b"\xff\x00", number),
    ]
    page.close()
    assert console.take() == ("page_closed", None, number)


def test_a_huge_message_closes_the_page(console: Console) -> None:
    """A message that is too long closes its page, and the link goes on."""
    page, number = console.open()
    page.send("x" * 100_000)
    assert console.take() == ("page_closed", None, number)
    console.open()[0].close()


@pytest.mark.parametrize("frames", FLOODS.values(), ids=FLOODS)
def test_a_page_that_floods_is_closed(console: Console, frames: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that sends too many frames of any kind is closed with a reason; another page's stop is delivered."""
    monkeypatch.setattr(read_limit, "READS_PER_S", 0)
    (page, number), (other, other_number) = console.open(), console.open()
    with suppress(OSError):  # the console reads only a part
        page.socket.sendall(frames * 10)
    with pytest.raises(ConnectionClosed) as raised:
        page.recv(timeout=10)  # nothing was sent to the page
    assert raised.value.rcvd == Close(*TOO_MANY_MESSAGES)
    other.send("stop")
    delivered: list[Delivered] = []
    while {("page_closed", None, number), ("page_message", "stop", other_number)} - set(delivered):
        delivered.append(console.take())
    assert len(delivered) <= FIRST_READS + 2
    assert console.link.counts["connections_too_busy"] == 1
    other.close()


def test_a_page_that_sends_single_bytes_is_closed(console: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page whose message arrives byte by byte costs a read for each byte, and is closed."""
    monkeypatch.setattr(read_limit, "READS_PER_S", 0)
    page, number = console.open()
    page.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with suppress(OSError):
        for byte in itertools.cycle(LONG):
            page.socket.send(bytes([byte]))
            pause(NS_PER_MS)  # a read for each byte
    while console.take() != ("page_closed", None, number):
        pass
    assert console.link.counts["connections_too_busy"] == 1


def test_a_page_that_is_closed_cannot_go_on_in_new_pages(console: Console) -> None:
    """The openings of pages are limited, whoever makes them; a page that is open stays so."""
    console.link._opening_limit = RefillingLimit(0, MAX_OPENINGS)  # however long the openings take
    page, number = console.open()
    for _ in range(MAX_OPENINGS - 1):
        console.open()[0].close()
        assert console.take()[0] == "page_closed"
    assert console.closing_code(HELLO) == TOO_MANY_OPENINGS.code
    page.send("a message")
    assert console.take() == ("page_message", "a message", number)
    page.close()


def test_too_many_connections_wait_unaccepted(console: Console, caplog: pytest.LogCaptureFixture) -> None:
    """Above the limit, connections wait in the kernel at no cost; later ones are served again; nothing is logged."""
    console.link._connection_limit = RefillingLimit(CONNECTIONS_PER_S, CONNECTIONS_PER_S)
    page, number = console.open()
    for _ in range(4 * CONNECTIONS_PER_S):
        socket.create_connection(("127.0.0.1", console.link.port), timeout=10).close()
    page.send("a message")
    assert console.take() == ("page_message", "a message", number)
    assert get(console.link.port, "/")[0] == 200
    assert 1 <= console.link.counts["accepts_paused"] <= 5
    assert caplog.records == []
    page.close()


def test_a_stop_behind_too_many_messages_is_delivered(console: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    """Above the limit, inputs are dropped and counted, and the emergency stop that follows them is delivered."""
    monkeypatch.setattr(message_limit, "MAX_MESSAGES_PER_S", 5)
    page, number = console.open()
    for _ in range(100):
        page.send("input")
    page.send(STOP)
    delivered = [console.take()]
    while delivered[-1] != ("page_message", STOP, number):
        delivered.append(console.take())
    assert console.link.counts["page_messages_too_many"] == 101 - len(delivered) > 0
    page.close()


def test_messages_reach_their_page(console: Console) -> None:
    """Statuses arrive as text and access units as bytes, each at its page; those for closed pages are dropped."""
    (first, one), (second, two) = console.open(), console.open()
    console.link.send(Send("page_unit", b"unit", one), Send("page_status", b"{}", two), Send("page_unit", b"", 99))
    assert first.recv(timeout=10) == b"unit"
    assert second.recv(timeout=10) == "{}"
    first.close()
    second.close()


def test_a_page_that_does_not_read_loses_statuses(console: Console) -> None:
    """A page that reads nothing delays nobody: statuses for it are dropped and counted."""
    page, number = console.open()
    for _ in range(3000):
        console.link.send(Send("page_status", b" " * 4096, number))
    other, other_number = console.open()
    console.link.send(Send("page_status", b"{}", other_number))
    assert other.recv(timeout=10) == "{}"
    assert console.link.counts["page_status_dropped"] > 0
    other.close()
    page.close()


def test_the_number_of_pages_is_limited(console: Console) -> None:
    """One page more than `MAX_PAGES` is closed with a code that says so."""
    pages = [console.open()[0] for _ in range(MAX_PAGES)]
    assert console.closing_code(HELLO) == TOO_MANY_PAGES.code
    for page in pages:
        page.close()


def test_the_number_of_strangers_is_limited(console: Console) -> None:
    """A connection too many without the token closes the oldest one, so that a new page gets in; pages do not count."""
    page, _ = console.open()
    strangers = [socket.create_connection(("127.0.0.1", console.link.port), timeout=10) for _ in range(MAX_STRANGERS)]
    late, _ = console.open()
    with suppress(ConnectionError):
        assert strangers[0].recv(1) == b""
    assert console.link.counts["connections_too_many"] == 1
    page.send("a message")
    assert console.take()[1] == "a message"
    for stranger in strangers:
        stranger.close()
    page.close()
    late.close()


def open_socket(port: int) -> socket.socket:
    """Return a connection that has opened the WebSocket, and has sent nothing yet."""
    site = f"127.0.0.1:{port}"
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13"
    connection = socket.create_connection(("127.0.0.1", port), timeout=10)
    connection.sendall(
        f"GET /socket HTTP/1.1\r\nHost: {site}\r\nOrigin: http://{site}\r\n{upgrade}\r\n{KEY}\r\n\r\n".encode()
    )
    assert b"101" in connection.recv(16)
    return connection


def test_a_flood_without_the_token_is_not_read(console: Console) -> None:
    """A connection that sends pings, and no token, is closed after a few KiB."""
    with open_socket(console.link.port) as sock:
        sock.sendall(PING * (MAX_STRANGER_BYTES // len(PING) + 1))
        with suppress(ConnectionError):
            while sock.recv(4096):
                pass
    assert console.link.counts["connections_too_long"] == 1


def test_frames_without_the_token_are_few(console: Console) -> None:
    """A connection without the token that sends many small frames is closed after a few, with few bytes."""
    with open_socket(console.link.port) as sock:
        sock.sendall(bytes([0x89, 0x80, 0, 0, 0, 0]) * MAX_STRANGER_READS)
        with suppress(ConnectionError):
            while sock.recv(4096):
                pass
    assert console.link.counts["connections_too_busy"] == 1


def test_a_page_that_reads_no_answers_is_closed(console: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that sends pings and reads no answers is closed before its answers fill the memory."""
    monkeypatch.setattr(console_link, "MAX_UNSENT_BYTES", 2**16)
    monkeypatch.setattr(read_limit, "FIRST_READS", 10**6)
    monkeypatch.setattr(read_limit, "MAX_READS", 10**6)
    with open_socket(console.link.port) as sock:
        hello = HELLO.encode()
        sock.sendall(bytes([0x81, 0x80 | len(hello), 0, 0, 0, 0]) + hello)
        assert console.take()[0] == "page_opened"
        with pytest.raises(OSError, match=r"reset|[Bb]roken"):
            sock.sendall(PING * 500_000)
    assert console.link.counts["connections_not_reading"] == 1


def test_garbage_on_the_port_changes_nothing(console: Console) -> None:
    """Bytes that are not HTTP end only their own connection."""
    for garbage in (b"\x00" * 5000, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 2000, b"POST / HTTP/1.1\r\n\r\n", b"\r\n"):
        with socket.create_connection(("127.0.0.1", console.link.port), timeout=10) as sock:
            sock.sendall(garbage)
            sock.shutdown(socket.SHUT_WR)
            while sock.recv(4096):
                pass
    assert get(console.link.port, "/")[0] == 200


def test_a_used_port_is_an_error_of_the_user(console: Console) -> None:
    """A port that another program uses gives one sentence."""
    with pytest.raises(UserError, match=f"port {console.link.port} cannot be opened"):
        ConsoleLink(MachineClock(), TOKEN, console.link.port)


def test_a_link_that_was_not_started_can_be_closed() -> None:
    """A link is closed without having been started, and its port is free again."""
    link = ConsoleLink(MachineClock(), TOKEN)
    link.close()
    ConsoleLink(MachineClock(), TOKEN, link.port).close()


def test_an_error_in_the_thread_fails_the_process() -> None:
    """If the delivery of a message raises, the link's thread ends with that error."""

    def fail(*_: Any) -> None:
        raise RuntimeError("delivery is broken")

    failures: list[BaseException] = []
    link = ConsoleLink(MachineClock(), TOKEN)
    with fail_on_thread_errors(failures.append):
        link.start(fail)
        own: Any = f"http://127.0.0.1:{link.port}"
        with connect(f"ws://127.0.0.1:{link.port}/socket", origin=own, proxy=None) as page:
            page.send(HELLO)
            assert link._thread is not None
            link._thread.join(10)
        link.close()
    assert [str(failure) for failure in failures] == ["delivery is broken"]


def test_without_the_package_the_user_gets_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package `websockets`, the error names the extra that installs it."""
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(UserError, match=r"\.\[console\]"):
        ConsoleLink(MachineClock(), TOKEN)
