"""Requests for runs and the transfer of a record, as the sweeping machine makes them."""

from __future__ import annotations

import hashlib
import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.support.clocks import ManualClock

from lavt.config import ClientConfig, RunConfig, SweepConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, Now, RunReply, RunRequest
from lavt.errors import UserError, WorkError
from lavt.experiment.runs import remote_run, run_requests
from lavt.experiment.runs.plan import plan_run, plan_sweep
from lavt.experiment.runs.remote_run import RemoteServer
from lavt.experiment.runs.run_requests import ConnectionLost, RunRefused, RunRequests, fetch_record
from lavt.node import Send
from lavt.transport.messages import decode, encode

DONE = RunReply(0, "", "", "finished", "completed", 5600, 5602, size=0, digest=b"", data=b"")
ARRIVED = Now(0, 0)
Answer = Callable[[RunRequest], list[bytes]]


class UnwaitedQueue(queue.Queue[bytes]):
    """A queue whose `get` does not wait: only the manual clock decides how long a request waits."""

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:  # noqa: ARG002 (as in the base class)
        """Return the next item, or raise `queue.Empty`."""
        return super().get(block=False)


class Network:
    """Delivers the answers to each request as soon as it is sent."""

    def __init__(self, answer: Answer) -> None:
        self.sent: list[RunRequest] = []
        self.requests = RunRequests("operator-1", ManualClock(step_ns=50 * NS_PER_MS), instance=5)
        self.requests._replies = UnwaitedQueue(64)
        self.requests.send = self._carry
        self._answer = answer

    def _carry(self, send: Send) -> None:
        self.sent.append(decode(RunRequest, send.payload))
        for payload in self._answer(self.sent[-1]):
            self.requests.deliver("run_reply", payload, ARRIVED, None)


def reply_to(request: RunRequest, **changed: Any) -> bytes:
    return encode(replace(DONE, number=request.number, **changed))


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fetch records and ask for the phase without pauses."""
    monkeypatch.setattr(run_requests, "PART_PERIOD_NS", 0)
    monkeypatch.setattr(remote_run, "POLL_NS", 0)


def test_a_request_is_repeated_until_it_is_answered() -> None:
    """A lost request is sent again with the same number; garbage and replies to other requests are ignored."""

    def answer(request: RunRequest) -> list[bytes]:
        if len(network.sent) < 3:
            return [b"garbage", reply_to(replace(request, number=request.number + 1)), bytes(40_000)]
        return [reply_to(request)]

    network = Network(answer)
    assert network.requests.request("status", 7).phase == "finished"
    assert [request.number for request in network.sent] == [1, 1, 1]
    assert 2 <= network.requests.longest_wait_s < 5
    network.requests.request("status", 7)
    assert network.sent[-1].number == 2


def test_a_server_that_does_not_answer_is_lost() -> None:
    """Without any answer, the request ends after a limited time."""
    network = Network(lambda _: [])
    with pytest.raises(ConnectionLost):
        network.requests.request("status", 7)
    assert 10 <= len(network.sent) <= 20


def test_a_refusal_has_its_code() -> None:
    """A refused request raises an error with the server's code."""
    network = Network(lambda request: [reply_to(request, refusal="busy", reason="operator-2\x1b[2J has a run")])
    with pytest.raises(RunRefused) as refused:
        network.requests.request("begin", 7)
    assert refused.value.refusal == "busy"
    assert str(refused.value).isprintable()


def test_waiting_replies_are_bounded() -> None:
    """A flood of replies is dropped, and does not delay the reply to the next request."""
    network = Network(lambda request: [reply_to(request)])
    for _ in range(1000):
        network.requests.deliver("run_reply", b"flood", ARRIVED, None)
    assert network.requests._replies.qsize() == 64
    assert network.requests.request("status", 7).phase == "finished"
    assert len(network.sent) == 1


RECORD = bytes(range(256)) * 300


def parts_of(record: bytes) -> Answer:
    return lambda request: [reply_to(request, data=record[request.offset : request.offset + 32_768])]


def announced(record: bytes) -> RunReply:
    return replace(DONE, size=len(record), digest=hashlib.sha256(record).digest())


def test_a_record_arrives_unchanged(tmp_path: Path) -> None:
    """The fetched file is the server's record."""
    fetch_record(Network(parts_of(RECORD)).requests, 7, announced(RECORD), tmp_path / "server.mcap")
    assert (tmp_path / "server.mcap").read_bytes() == RECORD


@pytest.mark.parametrize(
    ("answer", "announcement"),
    [
        (parts_of(RECORD[:-1] + b"x"), announced(RECORD)),
        (parts_of(RECORD[:-1]), announced(RECORD)),
        (parts_of(RECORD + b"x"), announced(RECORD)),
        (parts_of(b""), announced(RECORD)),
        (parts_of(RECORD), announced(b"")),
        (parts_of(RECORD), replace(DONE, size=10**12)),
    ],
    ids=["changed", "too short", "too long", "empty", "of no size", "of a huge size"],
)
def test_a_wrong_record_is_rejected(tmp_path: Path, answer: Answer, announcement: RunReply) -> None:
    """A record with another digest, parts of a wrong length and impossible sizes are errors; no transfer is endless."""
    with pytest.raises(WorkError):
        fetch_record(Network(answer).requests, 7, announcement, tmp_path / "server.mcap")


def test_the_transfer_of_a_record_has_a_deadline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the parts of a record arrive too slowly, the transfer ends with a sentence."""
    monkeypatch.setattr(run_requests, "FETCH_LIMIT_S", 0.5)
    endless = replace(DONE, size=4_000_000_000)
    network = Network(lambda request: [reply_to(request, data=bytes(32_768))])
    with pytest.raises(WorkError, match="arrived within"):
        fetch_record(network.requests, 7, endless, tmp_path / "server.mcap")
    assert len(network.sent) < 20


def test_each_phase_of_a_run_has_a_deadline() -> None:
    """A server that is always busy, or whose run never goes on, holds up a sweep for a limited time only."""
    busy = Network(lambda request: [reply_to(request, refusal="busy", reason="operator-2 has a run")])
    with pytest.raises(RunRefused, match="operator-2 has a run"):
        remote_run._begin(busy.requests, 7, "{}")
    stuck = Network(lambda request: [reply_to(request, phase="starting")])
    with pytest.raises(WorkError, match="still starting after 90 s"):
        remote_run._wait(stuck.requests, 7, lambda reply: reply.phase == "running", 90.0)


def test_runs_that_cannot_be_requested_are_rejected_at_once() -> None:
    """Before the first run, the sweep rejects virtual time, netem, routers without UDP, own roads and long settings."""
    server = RemoteServer(ClientConfig(), print)
    real = {"time": "real", "vehicle": {"route": "straight"}}
    server.check([plan_run(parse_config(RunConfig, real, "the test"))])
    server.check(plan_sweep(parse_config(SweepConfig, {**real, "conditions": ["L0", "L5"]}, "the test")))
    for change in (
        {"time": "virtual"},
        {"network": {"injection": "netem"}},
        {"vehicle": {"kind": "dbw", "dbw": {"interface": "inside"}}},
    ):
        with pytest.raises(UserError):
            server.check([plan_run(parse_config(RunConfig, {**real, **change}, "the test"))])
    settings = {"router_settings": {"connect": {"endpoints": ["tcp/192.0.2.1:7448"]}}}
    over_tcp = RemoteServer(parse_config(ClientConfig, {"zenoh": settings}, "the test"), print)
    with pytest.raises(UserError):
        over_tcp.check([plan_run(parse_config(RunConfig, real, "the test"))])
