from __future__ import annotations

import math
import queue
import socket

import pytest
from msgspec.structs import replace
from tests.support.clocks import ManualClock
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.cli import stop
from lavt.cli.session_log import NO_STATE_YET
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S, SessionReply, SessionRequest
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.zenoh_session import Router

REQUEST = SessionRequest("emergency_stop", "alice", 1, 60)
ACCEPTED = SessionReply(True, "", 0, b"", 5600, "kernel", 60)
REJECTED = SessionReply(False, "only the client that has control can release it", 0, b"", 5600, "kernel", 59)
CONFIG = str(shipped("configs/client.yaml"))
READING_STEP_NS = 100 * NS_PER_MS
"""The clock of `repeat` advances by this at each reading, and so between two queries."""
READINGS_PER_QUERY = 4
"""Two when the query is sent, and two while its reply is awaited."""


class Vehicle:
    """A vehicle that answers each query with the next of the `answers`; None is no answer."""

    def __init__(self, *answers: bytes | None) -> None:
        self.answers = list(answers)
        self.replies: queue.Queue[bytes] = queue.Queue()
        self.numbers: list[int] = []

    def send(self, *sends: Send) -> None:
        """Receive queries."""
        for query in sends:
            self.numbers.append(decode(SessionRequest, query.payload).number)
            answer = self.answers.pop(0) if self.answers else None
            if answer is not None:
                self.replies.put(answer)


def repeat(vehicle: Vehicle, timeout_s: float = 10.0) -> bool:
    """Repeat the stop until it is confirmed or the timeout is over; return whether it was confirmed."""
    clock = ManualClock(step_ns=READING_STEP_NS)
    return stop._is_confirmed(vehicle.send, vehicle.replies, REQUEST, clock, timeout_s)


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for one reply after each query, and not longer than 1 ms."""
    monkeypatch.setattr(stop, "RETRY_PERIOD_S", (READING_STEP_NS + NS_PER_MS) / NS_PER_S)


def test_a_stop_is_repeated_until_it_is_confirmed() -> None:
    """The query is repeated after lost queries, garbage and rejections, until it is confirmed."""
    vehicle = Vehicle(None, b"garbage", encode(REJECTED), None, encode(ACCEPTED))
    assert repeat(vehicle)
    assert vehicle.numbers == [60] * 5


def test_a_stop_that_was_cleared_gets_a_new_number() -> None:
    """A stop that was cleared before its confirmation arrived is sent with a new number, until that is confirmed."""
    late, confirmed = encode(ACCEPTED), encode(replace(ACCEPTED, emergency_stop=61))
    vehicle = Vehicle(None, encode(replace(REJECTED, emergency_stop=60)), late, None, confirmed)
    assert repeat(vehicle)
    assert vehicle.numbers == [60, 60, 61, 61, 61]


@pytest.mark.parametrize("timeout_s", [1.0, 10.0])
def test_a_stop_without_confirmation_fails_after_the_timeout(timeout_s: float) -> None:
    """The stop is repeated until the timeout."""
    vehicle = Vehicle()
    assert not repeat(vehicle, timeout_s)
    readings = round(timeout_s * NS_PER_S) // READING_STEP_NS - 1
    assert len(vehicle.numbers) == math.ceil(readings / READINGS_PER_QUERY)


def test_without_a_router_the_stop_is_reported_as_not_sent(run: Run) -> None:
    """Without a router the command tries until the timeout, fails, and says that the stop was not sent."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    sentence = run("stop", CONFIG, "--timeout", "0.3", "--set", f"zenoh.router={endpoint}").rejection()
    assert "NOT sent" in sentence
    assert endpoint in sentence


def test_with_an_invalid_key_the_stop_is_reported_as_not_sent(run: Run) -> None:
    """With a key that cannot be read, the command says that the stop was not sent."""
    failed = run("stop", CONFIG, "--set", "security.key=none", "--set", "security.vehicle=none")
    assert failed.code == 2
    assert "NOT sent" in failed.err
    assert failed.err.count("\n") == 1


def test_without_a_vehicle_the_exit_code_is_1(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a router but no vehicle, the command fails with exit code 1 and says that the stop was not confirmed."""
    monkeypatch.setattr(stop, "RETRY_PERIOD_S", 0.1)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    router = Router(shipped("zenoh-configs") / "router-client.json5", {"listen/endpoints": [endpoint]})
    try:
        result = run("stop", CONFIG, "--timeout", "0.3", "--set", f"zenoh.router={endpoint}")
    finally:
        router.close()
    assert (result.code, result.out) == (1, "")
    assert "NOT confirmed" in result.sentence()
    assert "`lavt doctor CONFIG`" in result.sentence()
    assert "`lavt doctor CONFIG`" in NO_STATE_YET
