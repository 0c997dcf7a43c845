from __future__ import annotations

import functools
import itertools
import json
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, Literal

import pytest
import zenoh
from tests.support.ports import free_port

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport import zenoh_link, zenoh_session
from lavt.transport.security.envelope import MAX_ENVELOPE_BYTES, MAX_RUN_REPLY_ENVELOPE_BYTES
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_link import RECEIVE_RING_LENGTH, REPLY_CHANNELS, ZenohLink
from lavt.transport.zenoh_session import Router, quiet_logs

ARRIVAL_TIMEOUT_S = 10.0
CONFIGS = shipped("zenoh-configs")
SESSION = CONFIGS / "session.json5"
LOCAL = "tcp/127.0.0.1:0"
"""An endpoint at which a router listens for sessions of its own machine."""
ROUTER_LINK = "udp/127.0.0.1:0?rel=1;mixed_rel=1"
"""An endpoint at which a router listens for other routers."""
REQUIRED_KEYS = "scouting: { multicast: { enabled: false } }, adminspace: { enabled: true }"


class Received:
    """The messages that a link delivered."""

    def __init__(self) -> None:
        self.messages: queue.Queue[tuple[str, Any, Now, Any]] = queue.Queue()
        self.payloads: list[Any] = []

    def __call__(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        """Store a message."""
        self.payloads.append(payload)
        self.messages.put((channel, payload, arrived, peer))

    def next(self, expected: tuple[str, bytes], send: Callable[[], None] | None = None) -> tuple[Now, Any]:
        """Wait for a payload on a channel; `send` sends it, repeatedly, because it may be lost or too early."""
        for _ in range(100):
            if send is not None:
                send()
            try:
                channel, payload, arrived, peer = self.messages.get(timeout=ARRIVAL_TIMEOUT_S / 100)
            except queue.Empty:
                continue
            if (channel, payload) == expected:
                return arrived, peer
        raise AssertionError(f"did not receive {expected}")


def loopback_endpoint(router: Router) -> str:
    """Return the loopback endpoint of a router."""
    return next(locator for locator in router.locators() if locator.startswith("tcp/"))


@pytest.fixture(scope="module")
def routers() -> Iterator[tuple[str, str]]:
    """Start the shipped routers on free ports, linked to each other; yield the endpoint of each side's router."""
    quiet_logs()
    with ExitStack() as stack:
        server = Router(CONFIGS / "router-server.json5", {"listen/endpoints": [LOCAL, ROUTER_LINK]})
        stack.callback(server.close)
        remote = next(locator for locator in server.locators() if locator.startswith("udp/"))
        port = remote.partition("?")[0].rpartition(":")[2]
        client = Router(
            CONFIGS / "router-client.json5",
            {"listen/endpoints": [LOCAL], "connect/endpoints": [f"udp/127.0.0.1:{port}?rel=1;mixed_rel=1"]},
        )
        stack.callback(client.close)
        yield loopback_endpoint(server), loopback_endpoint(client)


def session_at(endpoint: str, path: Path = SESSION) -> SessionSettings:
    """Return the settings of a session at a router's endpoint."""
    return SessionSettings(path, {"connect/endpoints": [endpoint]})


def open_link(
    side: Literal["server", "client"],
    router: str,
    *,
    vehicle: str = "vehicle-1",
    who: str | None = None,
    path: Path = SESSION,
) -> ZenohLink:
    return ZenohLink(
        MachineClock(),
        side=side,
        settings=session_at(router, path),
        vehicle=vehicle,
        who=f"{side}-1" if who is None else who,
    )


class Pair:
    """The started links of a server and a client of one vehicle."""

    def __init__(self, routers: tuple[str, str], vehicle: str) -> None:
        self.server_received, self.client_received = Received(), Received()
        self.server = open_link("server", routers[0], vehicle=vehicle)
        self.client = open_link("client", routers[1], vehicle=vehicle)
        self.server.start(self.server_received)
        self.client.start(self.client_received)

    def close(self) -> None:
        """Close both links."""
        self.client.close()
        self.server.close()


@pytest.fixture(scope="module")
def pair(routers: tuple[str, str]) -> Iterator[Pair]:
    """Start a server's and a client's link, each at the router of its own side."""
    with closing(Pair(routers, "vehicle-1")) as opened:
        yield opened


def test_control(pair: Pair) -> None:
    """A command reaches the server through both routers unchanged, with its time of arrival."""
    before = MachineClock().now()
    command = Send("control", b"\x00command")
    arrived, _ = pair.server_received.next(("control", b"\x00command"), lambda: pair.client.send(command))
    assert before.mono_ns <= arrived.mono_ns <= MachineClock().now().mono_ns


@pytest.mark.realtime
@pytest.mark.judges_times(share=0.05)
def test_the_newest_commands_are_kept_while_the_server_is_busy(routers: tuple[str, str]) -> None:
    """While a command is processed, the newest waiting commands are kept, and a query is delivered at once."""
    with closing(Pair(routers, "vehicle-busy")) as pair:
        blocked, resume = threading.Event(), threading.Event()
        received = pair.server_received

        def block(channel: str, payload: Any, arrived: Now, peer: Any) -> None:
            received(channel, payload, arrived, peer)
            if payload == b"block":
                blocked.set()
                resume.wait(ARRIVAL_TIMEOUT_S)

        pair.server._deliver = block
        received.next(("control", b"block"), lambda: pair.client.send(Send("control", b"block")))
        assert blocked.wait(ARRIVAL_TIMEOUT_S)
        received.payloads.clear()
        arrived: list[None] = []
        key = f"{pair.server._base}/control"
        _observer = pair.server._session.declare_subscriber(key, lambda _: arrived.append(None))
        for number in range(1000 * RECEIVE_RING_LENGTH):
            pair.client.send(Send("control", b"%d" % number))
            if len(arrived) >= 3 * RECEIVE_RING_LENGTH:
                break
            if number % 32 == 0:
                pause(NS_PER_MS)  # Zenoh drops commands that are sent too fast
        received.next(("session", b"query"), lambda: pair.client.send(Send("session", b"query")))
        assert set(received.payloads) == {b"query"}
        resume.set()
        for _ in range(100):
            pair.client.send(Send("control", b"last"))
            pause(round(ARRIVAL_TIMEOUT_S * NS_PER_S / 100))
            if b"last" in received.payloads:
                break
        numbers = [int(payload) for payload in received.payloads if payload.isdigit()]
        assert b"last" in received.payloads
        assert numbers == sorted(numbers)
        assert 0 < len(numbers) < number - RECEIVE_RING_LENGTH
        assert numbers[0] > RECEIVE_RING_LENGTH


def test_state(pair: Pair) -> None:
    """A state reaches the client through both routers unchanged."""
    pair.client_received.next(("state", b"state\xff"), lambda: pair.server.send(Send("state", b"state\xff")))


@pytest.mark.parametrize(("channel", "reply"), [("session", "session_reply"), ("netem", "netem_reply")])
def test_queries(pair: Pair, channel: str, reply: str) -> None:
    """A client's query reaches the server, and the server's reply reaches the client."""
    query = Send(channel, b"query")
    _, peer = pair.server_received.next((channel, b"query"), lambda: pair.client.send(query))
    pair.server.send(Send(reply, b"reply", peer))
    pair.client_received.next((reply, b"reply"))


def test_only_a_server_of_runs_answers_requests_for_runs(pair: Pair, routers: tuple[str, str]) -> None:
    """A link that answers runs gets no other query; an ordinary server's link gets no request for a run."""
    received = Received()
    with closing(open_link("server", routers[0])) as runs:
        runs.start(received, answers_runs_only=True)
        send = pair.client.send
        _, peer = received.next(("run", b"begin"), lambda: send(Send("session", b"ask"), Send("run", b"begin")))
        part = bytes(32_768)
        pair.client_received.next(("run_reply", part), lambda: runs.send(Send("run_reply", part, peer)))
        pair.server_received.next(("session", b"ask"), lambda: send(Send("session", b"ask"), Send("run", b"begin")))
    assert set(received.payloads) == {b"begin"}
    assert b"begin" not in pair.server_received.payloads


def test_reply_without_a_query(pair: Pair) -> None:
    """A reply is not sent if no query is pending, or if the query has been answered."""
    query = Send("session", b"number")
    _, peer = pair.server_received.next(("session", b"number"), lambda: pair.client.send(query))
    pair.server.send(Send("session_reply", b"no query", 10**9), Send("netem_reply", b"no query", peer))
    pair.server.send(Send("session_reply", b"first", peer), Send("session_reply", b"second", peer))
    pair.client_received.next(("session_reply", b"first"))
    _, next_peer = pair.server_received.next(("session", b"number"), lambda: pair.client.send(query))
    pair.server.send(Send("session_reply", b"following", next_peer))
    pair.client_received.next(("session_reply", b"following"))
    assert not {b"no query", b"second"} & set(pair.client_received.payloads)
    assert not [name for name in pair.server.counts if name.endswith("_reply_not_sent")]


def test_vehicles_do_not_mix(pair: Pair, routers: tuple[str, str]) -> None:
    """A message for one vehicle does not reach another vehicle at the same router."""
    with closing(Pair(routers, "vehicle-2")) as other:
        other.server_received.next(("control", b"for two"), lambda: other.client.send(Send("control", b"for two")))
        pair.server_received.next(("control", b"for one"), lambda: pair.client.send(Send("control", b"for one")))
        assert b"for two" not in pair.server_received.payloads
        assert b"for one" not in other.server_received.payloads


@pytest.mark.parametrize("channel", ["control", "session", "session_reply"])
def test_an_error_in_a_receiving_thread_is_not_lost(routers: tuple[str, str], channel: str) -> None:
    """An error in the delivery of a message is reported as a thread's error, which ends the process."""
    failed: queue.Queue[BaseException] = queue.Queue()

    def deliver(received: str, _payload: Any, _arrived: Now, peer: Any) -> None:
        if received == channel:
            raise BrokenPipeError
        if received == "session":
            links.server.send(Send("session_reply", b"x", peer))

    with fail_on_thread_errors(failed.put), closing(Pair(routers, f"broken-{channel}")) as links:
        links.server._deliver = links.client._deliver = deliver
        for _ in range(100):
            links.client.send(Send(channel.removesuffix("_reply"), b"x"))
            with suppress(queue.Empty):
                assert isinstance(failed.get(timeout=ARRIVAL_TIMEOUT_S / 100), BrokenPipeError)
                return
    pytest.fail("the error was lost")


def test_the_end_of_a_subscription_is_not_lost(routers: tuple[str, str]) -> None:
    """The end of a subscription of an open link is reported as a thread's error; closing the link still works."""
    failed: queue.Queue[BaseException] = queue.Queue()
    with fail_on_thread_errors(failed.put), closing(Pair(routers, "ended")) as pair:
        pair.server._declared[0].undeclare()
        assert isinstance(failed.get(timeout=ARRIVAL_TIMEOUT_S), zenoh.ZError)
    assert failed.empty()


@pytest.mark.usefixtures("pair")
def test_liveliness(routers: tuple[str, str]) -> None:
    """A link's liveliness token is visible at the other side's router while the link is open."""
    config = zenoh.Config.from_file(str(SESSION))
    config.insert_json5("connect/endpoints", json.dumps([routers[0]]))
    changes: queue.Queue[tuple[str, bool]] = queue.Queue()
    with zenoh.open(config) as session:
        watch = session.liveliness().declare_subscriber(
            "lavt/vehicle-1/alive/*",
            lambda sample: changes.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)),
            history=True,
        )
        present = {changes.get(timeout=ARRIVAL_TIMEOUT_S) for _ in range(2)}
        assert present == {(f"lavt/vehicle-1/alive/{who}", True) for who in ("server-1", "client-1")}
        visitor = open_link("client", routers[1], who="visitor")
        visitor.start(Received())
        assert changes.get(timeout=ARRIVAL_TIMEOUT_S) == ("lavt/vehicle-1/alive/visitor", True)
        visitor.close()
        assert changes.get(timeout=ARRIVAL_TIMEOUT_S) == ("lavt/vehicle-1/alive/visitor", False)
        watch.undeclare()


def test_query_without_a_server(routers: tuple[str, str]) -> None:
    """A query without a reply is not an error, and the link can be closed."""
    received = Received()
    with closing(open_link("client", routers[1], vehicle="nobody")) as alone:
        alone.start(received)
        alone.send(Send("session", b"query"))
        alone.send(Send("control", b"command"))
    assert received.messages.empty()


def test_a_session_that_does_not_close_lets_the_process_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a peer keeps the router so busy that the session does not close in time, the process ends without an error."""
    ends: list[bool] = []

    class BusySession:
        def close(self) -> None:
            raise zenoh.ZError("close operation timed out!")

    monkeypatch.setattr(zenoh_session, "end_process_later", lambda: ends.append(True))
    busy: Any = BusySession()
    zenoh_session.close_session(busy)
    assert ends == [True]


def test_send_after_close(routers: tuple[str, str]) -> None:
    """A message that is sent after the session was closed is counted and raises nothing."""
    closed = open_link("client", routers[1], vehicle="closed")
    closed.start(Received())
    closed.close()
    for channel in ("session", "control"):
        closed.send(Send(channel, b"x"))
    assert closed.counts == {"session_not_sent": 1, "control_not_sent": 1}


BAD_NAMES = ["a/b", "**", "*", "", "a" * 33, "-a", "_a", "a b", "a$*", "a#", "a?", "é", "a\n", "@"]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names(name: str) -> None:
    """A vehicle or client name with a meaning in a Zenoh key raises a UserError before a session is opened."""
    for vehicle, who in ((name, "operator-1"), ("vehicle-1", name)):
        with pytest.raises(UserError, match="1 to 32 letters"):
            ZenohLink(
                MachineClock(),
                side="client",
                settings=session_at("tcp/127.0.0.1:1"),
                vehicle=vehicle,
                who=who,
            )


def open_embedded(side: Literal["server", "client"], changes: dict[str, Any], *, vehicle: str) -> ZenohLink:
    """Open a link whose session is a router with the shipped config of this side."""
    settings = SessionSettings(CONFIGS / f"router-{side}.json5", changes, is_router=True)
    return ZenohLink(MachineClock(), side=side, settings=settings, vehicle=vehicle, who=f"{side}-1")


def dialling(port: int) -> dict[str, Any]:
    """Return the changes of a router that dials a port of this machine and listens nowhere."""
    return {"listen/endpoints": [], "connect/endpoints": [f"udp/127.0.0.1:{port}?rel=1;mixed_rel=1"]}


def listening(port: int) -> dict[str, Any]:
    """Return the changes of a router that listens at a port of this machine."""
    return {"listen/endpoints": [f"udp/127.0.0.1:{port}?rel=1;mixed_rel=1"]}


def open_server_again(port: int, vehicle: str) -> ZenohLink:
    """Open a server's link that is a router, as soon as the port of the link before it is free."""
    for _ in range(100):
        with suppress(UserError):
            return open_embedded("server", listening(port), vehicle=vehicle)
        pause(round(ARRIVAL_TIMEOUT_S * NS_PER_S) // 100)
    raise AssertionError(f"port {port} stays in use")


def exchange_all_kinds(server: ZenohLink, server_received: Received, client: ZenohLink, received: Received) -> None:
    """Exchange a command, a state, and a query with its reply."""
    server_received.next(("control", b"command"), lambda: client.send(Send("control", b"command")))
    received.next(("state", b"state"), lambda: server.send(Send("state", b"state")))
    _, peer = server_received.next(("session", b"request"), lambda: client.send(Send("session", b"request")))
    server.send(Send("session_reply", b"reply", peer))
    received.next(("session_reply", b"reply"))


def test_sides_that_are_routers_themselves() -> None:
    """Two links that are routers exchange all kinds of messages, whichever side starts first, also after a restart."""
    port, received = free_port(), Received()
    with closing(open_embedded("client", dialling(port), vehicle="embedded")) as client:
        assert client.locators() == []
        client.start(received)
        client.send(Send("control", b"into the void"))
        for _ in range(2):
            server_received = Received()
            with closing(open_server_again(port, "embedded")) as server:
                assert [str(port) in locator for locator in server.locators()] == [True]
                server.start(server_received)
                exchange_all_kinds(server, server_received, client, received)


@pytest.mark.parametrize("runs_only", [False, True])
def test_a_client_begins_when_it_reaches_the_server(*, runs_only: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that is a router and finds a running server knows its queries when its start ends.

    So its first request is not lost.
    """
    monkeypatch.setattr(zenoh_link, "FIRST_LINK_LIMIT_S", ARRIVAL_TIMEOUT_S)
    port = free_port()
    with (
        closing(open_embedded("server", listening(port), vehicle="first")) as server,
        closing(open_embedded("client", dialling(port), vehicle="first")) as client,
    ):
        server.start(Received(), answers_runs_only=runs_only)
        client.start(Received(), queries_only=runs_only)
        querier = client._session.declare_querier(f"lavt/first/{'run' if runs_only else 'session'}")
        assert querier.matching_status.matching


def test_an_embedded_router_whose_port_is_in_use() -> None:
    """A link that is a router raises a UserError that names the endpoint if its port is in use."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as occupant:
        occupant.bind(("127.0.0.1", 0))
        port = occupant.getsockname()[1]
        with pytest.raises(UserError, match=rf"127\.0\.0\.1:{port}.*use other endpoints") as error:
            open_embedded("server", listening(port), vehicle="occupied")
    assert is_one_plain_line(error)


def test_a_router_without_listen_endpoints_in_its_file(tmp_path: Path) -> None:
    """Without listen endpoints in the file a link is not opened, because Zenoh would listen on all interfaces."""
    path = tmp_path / "router.json5"
    path.write_text(f'{{ mode: "router", {REQUIRED_KEYS} }}')
    settings = SessionSettings(path, is_router=True)
    with pytest.raises(UserError, match="no listen endpoints"):
        ZenohLink(MachineClock(), side="server", settings=settings, vehicle="anywhere", who="server")


def test_a_panic_while_a_session_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    """If Zenoh panics while it opens a session, a `UserError` with the panic's text is raised."""

    class PanicException(BaseException):
        """A stand-in for pyo3's exception, which is no `Exception` either."""

    def panic(_: zenoh.Config) -> zenoh.Session:
        raise PanicException("called `Option::unwrap()` on a `None` value")

    monkeypatch.setattr(zenoh, "open", panic)
    with pytest.raises(UserError, match="Option::unwrap"):
        open_embedded("client", dialling(1), vehicle="panic")
    with pytest.raises(UserError, match="Option::unwrap"):
        open_link("client", "tcp/127.0.0.1:1")


def is_one_plain_line(error: pytest.ExceptionInfo[UserError]) -> bool:
    text = str(error.value)
    return "\n" not in text and ".rs" not in text and "Location" not in text and len(text) < 1000


def unanswered_endpoint() -> str:
    """Return an endpoint at which no router answers."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


def test_no_router() -> None:
    """Without a router, the error names the endpoint and the command that starts a router."""
    endpoint = unanswered_endpoint()
    with pytest.raises(UserError, match=rf"{endpoint}.*lavt router") as error:
        open_link("server", endpoint)
    assert is_one_plain_line(error)


def test_waiting_for_a_router() -> None:
    """A waiting link reports the reason once, counts unsent messages, and sends as soon as a router answers."""
    endpoint, reasons, received = unanswered_endpoint(), list[str](), Received()
    with ExitStack() as stack:
        waiting = ZenohLink(
            MachineClock(),
            side="client",
            settings=session_at(endpoint),
            vehicle="late",
            who="client-1",
            waiting=reasons.append,
        )
        stack.callback(waiting.close)
        assert reasons == []
        waiting.start(Received())
        waiting.send(Send("control", b"too early"), Send("session", b"too early"))
        assert waiting.counts["control_not_sent"] == waiting.counts["session_not_sent"] == 1
        stack.callback(Router(CONFIGS / "router-server.json5", {"listen/endpoints": [endpoint]}).close)
        server = open_link("server", endpoint, vehicle="late")
        stack.callback(server.close)
        server.start(received)
        received.next(("control", b"now"), lambda: waiting.send(Send("control", b"now")))
    assert len(reasons) == 1
    assert endpoint in reasons[0]


class RefusingSession:
    """A real Zenoh session that declares no queryable."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the real session."""
        return getattr(self.session, name)

    def declare_queryable(self, *_: Any) -> Any:
        """Fail like a session whose router has gone."""
        raise zenoh.ZError("no")


def test_a_failed_declaration_in_the_background_is_not_silent(
    routers: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a session that opens later cannot declare everything, its thread fails, and the session is closed."""
    failed: queue.Queue[BaseException] = queue.Queue()
    opened: list[RefusingSession] = []
    open_session, attempts = zenoh.open, itertools.count()

    def open_later(config: zenoh.Config) -> Any:
        if next(attempts) == 0:
            raise zenoh.ZError("no router")
        opened.append(RefusingSession(open_session(config)))
        return opened[-1]

    monkeypatch.setattr(zenoh, "open", open_later)
    waiting = ZenohLink(
        MachineClock(),
        side="server",
        settings=session_at(routers[0]),
        vehicle="refused",
        who="server-1",
        waiting=lambda _: None,
    )
    with fail_on_thread_errors(failed.put), closing(waiting):
        waiting.start(Received())
        assert isinstance(failed.get(timeout=ARRIVAL_TIMEOUT_S), zenoh.ZError)
        waiting.send(Send("state", b"x"))
    assert waiting.counts["state_not_sent"] == 1
    assert [session.session.is_closed() for session in opened] == [True]
    assert failed.empty()


def test_closing_while_waiting_for_a_router() -> None:
    """A link that still waits for its router can be closed."""
    with closing(
        ZenohLink(
            MachineClock(),
            side="server",
            settings=session_at(unanswered_endpoint()),
            vehicle="late",
            who="server",
            waiting=lambda _: None,
        )
    ) as waiting:
        waiting.start(Received())


@pytest.mark.parametrize("endpoint", ["nonsense", "foo/127.0.0.1:1", "tcp/127.0.0.1", "tcp/127.0.0.1:99999"])
def test_bad_endpoint(endpoint: str) -> None:
    """An invalid endpoint raises a UserError that names it."""
    with pytest.raises(UserError, match=endpoint) as error:
        open_link("server", endpoint)
    assert is_one_plain_line(error)


ROUTER_PROBLEMS = {
    "unknown key": (f'{{ mode: "router", lisen: {{}}, {REQUIRED_KEYS} }}', "unknown field `lisen`"),
    "wrong mode": ('{ mode: "routr" }', "unknown variant `routr`"),
    "wrong type": (f'{{ mode: "router", listen: {{ endpoints: 5 }}, {REQUIRED_KEYS} }}', "invalid type"),
    "not JSON5": ('{ mode: "router', "not a Zenoh config"),
    "empty": ("", "not a Zenoh config"),
    "mode of a session": (f'{{ mode: "client", {REQUIRED_KEYS} }}', 'mode: "router"'),
    "no mode": (f"{{ {REQUIRED_KEYS} }}", 'mode: "router"'),
    "no listen endpoints": (f'{{ mode: "router", {REQUIRED_KEYS} }}', "no listen endpoints"),
    "an empty list": (f'{{ mode: "router", listen: {{ endpoints: [] }}, {REQUIRED_KEYS} }}', "no listen endpoints"),
    "endpoints of a peer": (
        f'{{ mode: "router", listen: {{ endpoints: {{ peer: ["{LOCAL}"] }} }}, {REQUIRED_KEYS} }}',
        "no listen endpoints",
    ),
    "no admin space": (f'{{ mode: "router", listen: {{ endpoints: ["{LOCAL}"] }} }}', "adminspace"),
    "unknown protocol": (f'{{ mode: "router", listen: {{ endpoints: ["foo/127.0.0.1:0"] }}, {REQUIRED_KEYS} }}', "foo"),
    "address of another machine": (
        f'{{ mode: "router", listen: {{ endpoints: ["tcp/192.0.2.1:0"] }}, {REQUIRED_KEYS} }}',
        "192.0.2.1",
    ),
}


@pytest.mark.parametrize("problem", ROUTER_PROBLEMS)
def test_bad_router_config(problem: str, tmp_path: Path) -> None:
    """An invalid config of a router raises a UserError that names the file and the problem."""
    text, expected = ROUTER_PROBLEMS[problem]
    path = tmp_path / "router.json5"
    path.write_text(text)
    with pytest.raises(UserError, match=r"router\.json5") as error:
        Router(path, {})
    assert expected in str(error.value)
    assert is_one_plain_line(error)


def test_binary_router_config(tmp_path: Path) -> None:
    """A config file that is not text raises a UserError that names the file."""
    path = tmp_path / "router.json5"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UserError, match=r"router\.json5") as error:
        Router(path, {})
    assert is_one_plain_line(error)


@pytest.mark.parametrize("name", ["nothing.json5", "."])
def test_missing_file(name: str, tmp_path: Path) -> None:
    """A missing config file raises a UserError that names the directory of the shipped configs."""
    with pytest.raises(UserError, match=r"there is no Zenoh config .*zenoh-configs/"):
        Router(tmp_path / name, {})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("lisen/endpoints", ["x"]),
        ("listen/endpoints", 5),
        ("listen/endpoints", {1, 2}),
        ("transport/unicast/open_timeout", "long"),
        ("mode", float("nan")),
    ],
)
def test_bad_override(key: str, value: Any) -> None:
    """An override that the config cannot take raises a UserError that names the key with dots, as the user wrote it."""
    with pytest.raises(UserError, match=key.replace("/", r"\.")) as error:
        Router(CONFIGS / "router-server.json5", {key: value})
    assert is_one_plain_line(error)


def test_port_in_use() -> None:
    """A router whose port is in use raises a UserError that names the endpoint."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match=endpoint) as error:
            Router(CONFIGS / "router-server.json5", {"listen/endpoints": [endpoint]})
    assert is_one_plain_line(error)


ENCRYPTED = "quic/127.0.0.1:0?mixed_rel=1"
ENDPOINTS = {
    "router-server.json5": [LOCAL, ROUTER_LINK],
    "router-client.json5": [LOCAL],
    "router-cloud.json5": [LOCAL, ROUTER_LINK],
    "router-server-to-cloud.json5": [LOCAL],
    "router-server-tls.json5": ["unixsock-stream/{}/zenoh.sock", ENCRYPTED],
    "router-client-tls.json5": ["unixsock-stream/{}/zenoh.sock"],
    "router-cloud-tls.json5": [ENCRYPTED],
    "router-server-to-cloud-tls.json5": ["unixsock-stream/{}/zenoh.sock"],
    "session.json5": LOCAL,
    "session-unix.json5": "unixsock-stream/{}/zenoh.sock",
}
"""Free listen endpoints for the shipped routers, or the router's endpoint for a session; {} is a directory."""


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the keys that the shipped configs need, in a directory `keys`."""
    pytest.importorskip("cryptography")
    from lavt.cli.keys import keys

    directory = tmp_path_factory.mktemp("made") / "keys"
    keys(directory, vehicle=["vehicle-1"], operator=["operator-1"], cloud=["cloud-1"])
    return directory


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.iterdir()))
def test_shipped_configs(
    name: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh opens every file of zenoh-configs/, the encrypted ones with the keys that `lavt keys` makes."""
    endpoints = ENDPOINTS[name]
    if isinstance(endpoints, str):
        endpoint = endpoints.format(tmp_path)
        with closing(Router(CONFIGS / "router-server.json5", {"listen/endpoints": [endpoint]})) as router:
            connect = loopback_endpoint(router) if endpoint == LOCAL else endpoint
            open_link("server", connect, vehicle="shipped", path=CONFIGS / name).close()
        return
    if "-tls" in name:
        monkeypatch.chdir(request.getfixturevalue("keys").parent)
    with closing(
        Router(CONFIGS / name, {"listen/endpoints": [endpoint.format(tmp_path) for endpoint in endpoints]})
    ) as router:
        assert len(router.locators()) >= len(endpoints)


@pytest.mark.parametrize("security", ["", "-tls"])
def test_both_routers_can_run_on_one_machine(security: str) -> None:
    """The routers of a server and of a client listen on different ports and sockets."""
    server, client = (
        json.loads(zenoh.Config.from_file(str(CONFIGS / f"router-{side}{security}.json5")).get_json("listen/endpoints"))
        for side in ("server", "client")
    )
    assert server
    assert client
    assert not {*server} & {*client}


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.iterdir()))
def test_shipped_configs_use_no_scouting(name: str) -> None:
    """Every shipped config disables scouting by multicast and gossip, and Zenoh's timestamps.

    A router would wait at its start for the answers to scouting, so this wait is 0.
    """
    config = zenoh.Config.from_file(str(CONFIGS / name))
    if json.loads(config.get_json("mode")) == "router":
        assert json.loads(config.get_json("scouting/delay")) == 0
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("timestamping/enabled")) is False


@pytest.mark.parametrize(
    ("dialling", "dialled"),
    [
        ("router-client.json5", "router-server.json5"),
        ("router-client.json5", "router-cloud.json5"),
        ("router-server-to-cloud.json5", "router-cloud.json5"),
    ],
)
def test_one_side_dials(dialling: str, dialled: str) -> None:
    """Of two linked shipped routers only one dials, and both use the same parameters of the link."""
    endpoints = {
        (name, direction): json.loads(zenoh.Config.from_file(str(CONFIGS / name)).get_json(f"{direction}/endpoints"))
        for name in (dialling, dialled)
        for direction in ("listen", "connect")
    }
    assert endpoints[dialled, "connect"] == []
    (dialled_endpoint,) = endpoints[dialling, "connect"]
    listen_endpoint = next(endpoint for endpoint in endpoints[dialled, "listen"] if endpoint.startswith("udp/"))
    for endpoint in (dialled_endpoint, listen_endpoint):
        assert set(endpoint.partition("?")[2].split(";")) == {"rel=1", "mixed_rel=1"}
    assert all(endpoint.startswith("tcp/127.0.0.1:") for endpoint in endpoints[dialling, "listen"])


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.iterdir() if "-tls" in path.name))
def test_encrypted_configs_restrict_access(name: str) -> None:
    """An encrypted router accepts sessions by a Unix socket only, requires mutual TLS and limits message sizes."""
    config = zenoh.Config.from_file(str(CONFIGS / name))
    endpoints = json.loads(config.get_json("listen/endpoints"))
    assert {endpoint.partition("/")[0] for endpoint in endpoints} <= {"unixsock-stream", "quic"}
    assert all("mixed_rel=1" in endpoint for endpoint in endpoints if endpoint.startswith("quic"))
    tls = json.loads(config.get_json("transport/link/tls"))
    assert (tls["enable_mtls"], tls["verify_name_on_connect"], tls["close_link_on_expiration"]) == (True, True, True)
    limits = {limit["id"]: limit for limit in json.loads(config.get_json("low_pass_filter"))}
    sizes = {name: limit["size_limit"] for name, limit in limits.items()}
    assert sizes == {"short": MAX_ENVELOPE_BYTES, "replies": MAX_ENVELOPE_BYTES, "parts": MAX_RUN_REPLY_ENVELOPE_BYTES}
    assert limits["parts"]["key_exprs"] == ["**"]
    short = [zenoh.KeyExpr(key) for key in limits["replies"]["key_exprs"]]
    for key in (
        *(f"lavt/v/{name}" for name in REPLY_CHANNELS),
        "lavt/v/state",
        "lavt/v/alive/x",
        "x",
        "x/y",
        "a/b/c/d/e",
    ):
        assert any(limited.intersects(key) for limited in short) is (key != "lavt/v/run"), key
    access = json.loads(config.get_json("access_control"))
    assert access["enabled"] is (name != "router-client-tls.json5")
    assert access["default_permission"] == "deny"
    defined_rules = {rule["id"] for rule in access["rules"] or ()}
    assert defined_rules == {rule for policy in access["policies"] or () for rule in policy["rules"]}


def test_only_replies_about_runs_can_be_long() -> None:
    """With the filter of an encrypted router, a part of a record passes on the key `run`, and on no other one."""
    limits = zenoh.Config.from_file(str(CONFIGS / "router-server-tls.json5")).get_json("low_pass_filter")
    filtering = {"listen/endpoints": [LOCAL], "low_pass_filter": json.loads(limits)}
    config = zenoh.Config.from_file(str(SESSION))
    with closing(Router(CONFIGS / "router-server.json5", filtering)) as router:
        config.insert_json5("connect/endpoints", json.dumps([loopback_endpoint(router)]))
        with zenoh.open(config) as server, zenoh.open(config) as client:
            longest = {}
            for key in ("lavt/v/run", "lavt/v/session", "lavt/v/info", "lavt/v/alive/x", "x/y"):
                queryable = server.declare_queryable(
                    key, lambda query, key=key: query.reply(key, bytes(int(query.parameters["bytes"])))
                )
                ask = functools.partial(_longest_reply, client, key)
                assert any(ask(1) for _ in range(100)), "the router knows the key after a moment"
                longest[key] = max(ask(size) for size in (1280, 1281, 34_048, 34_049))
                queryable.undeclare()
    assert longest.pop("lavt/v/run") == 34_048
    assert set(longest.values()) == {1280}


def _longest_reply(session: zenoh.Session, key: str, size: int) -> int:
    """Query a key for a reply of this size; return the size of the longest reply, 0 without any."""
    replies = session.get(f"{key}?bytes={size}", timeout=ARRIVAL_TIMEOUT_S)
    return max((len(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None), default=0)


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIGS.glob("router-*.json5") if "tls" not in path.name))
def test_plain_configs_say_so(name: str) -> None:
    """The first line of an unencrypted router's config restricts it to a lab or a VPN."""
    assert "not encrypted" in (first := (CONFIGS / name).read_text().partition("\n")[0])
    assert "a lab or a VPN" in first


def test_both_dial_a_router_in_the_cloud() -> None:
    """A command reaches the server through a router in the cloud, to which each side's router has one link."""
    with ExitStack() as stack:

        def router(name: str, changes: dict[str, Any]) -> Router:
            opened = Router(CONFIGS / name, changes)
            stack.callback(opened.close)
            return opened

        cloud = router("router-cloud.json5", {"listen/endpoints": [ROUTER_LINK]})
        port = cloud.locators()[0].partition("?")[0].rpartition(":")[2]
        dials = {"listen/endpoints": [LOCAL], "connect/endpoints": [f"udp/127.0.0.1:{port}?rel=1;mixed_rel=1"]}
        sides = [router(name, dials) for name in ("router-server-to-cloud.json5", "router-client.json5")]
        server_endpoint, client_endpoint = (loopback_endpoint(side) for side in sides)
        pair = stack.enter_context(closing(Pair((server_endpoint, client_endpoint), "vehicle-1")))
        pair.server_received.next(("control", b"far"), lambda: pair.client.send(Send("control", b"far")))
        routers = pair.client.routers()
        assert routers is not None
        assert (routers.linked, len(set(routers.versions))) == (1, 1)
