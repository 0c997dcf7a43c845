from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace
from tests.nodes.stand_ins import at, deliver, payloads

from lavt.domain import NS_PER_MS, NS_PER_S, NetemReply, NetemRequest
from lavt.node import WAKE, Send
from lavt.nodes.injection import LEASE_MS, InjectionClient, InjectionNode
from lavt.nodes.payloads import InjectionSample, StationaryStatus
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.messages import ELLIPSIS, decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult

L4 = NetemRequest(
    who="alice",
    instance=7,
    condition="L4",
    lease_ms=LEASE_MS,
    delay_ms=150.0,
    jitter_ms=0.0,
    jitter_correlation=0.0,
    jitter_distribution="normal",
    loss=0.0,
    loss_burst_packets=0.0,
    rate_bps=0,
    reorder=0.0,
    state_delay_ms=0.0,
)
VIDEO = ImpairedFlow("video", "udp", 5600, "source", Impairment(150.0))
STATE = ImpairedFlow("state", "udp", 7448, "source", Impairment())
CONTROL = ImpairedFlow("control", "udp", 7448, "destination", Impairment(75.0))
GRANTED = ""
"""The reason in a reply that grants a request."""


def server(*, allowed: bool = True, simulated: bool = True) -> InjectionNode:
    return InjectionNode(allowed=allowed, simulated=simulated, video_port=5600, control=("udp", 7448))


def request(node: InjectionNode, condition: NetemRequest, after_ns: int = 0, peer: Any = 1) -> list[Send]:
    return deliver(node, "netem", encode(condition), at(after_ns), peer)


def deliver_result(
    node: InjectionNode | InjectionClient, number: int, reason: str = "", after_ns: int = 0
) -> list[Send]:
    """Deliver the injector's result of the order `number`; with a reason, the order failed."""
    measured = () if reason else (("video", 150.2),)
    return deliver(node, "injected", InjectionResult(number, reason, "", measured), at(after_ns))


def deliver_status(node: InjectionNode, status: StationaryStatus) -> list[Send]:
    """Deliver a status of the vehicle, for which the channel is `rest`."""
    return deliver(node, "rest", status, at(0))


def reply_reasons(sends: list[Send]) -> list[str]:
    """Return the reason in each reply: why a request was rejected, or `GRANTED`."""
    replies = [decode(NetemReply, payload) for payload in payloads(sends, "netem_reply")]
    assert all(reply.granted == (reply.reason == GRANTED) for reply in replies)
    return [reply.reason for reply in replies]


def server_with_condition(condition: NetemRequest = L4) -> InjectionNode:
    """Return a server with a condition in force."""
    node = server()
    request(node, condition)
    deliver_result(node, 1)
    return node


# The server.


def test_a_condition_is_granted_when_in_force() -> None:
    """A condition is granted once the queues report that it is in force."""
    node = server()
    assert request(node, L4) == [Send("inject", InjectionOrder(1, "L4", (VIDEO, STATE)))]
    sends = deliver_result(node, 1)
    assert reply_reasons(sends) == [GRANTED]
    assert [send.peer for send in sends if send.channel == "netem_reply"] == [1]
    assert payloads(sends, "injection") == [
        InjectionSample(at(0).mono_ns, "L4", "video", 150.0, 150.2, ""),
        InjectionSample(at(0).mono_ns, "L4", "state", 0.0, None, ""),
    ]


def test_a_state_delay_applies_to_the_router() -> None:
    """A state delay applies to the packets from the router's listening port."""
    [send] = request(server(), replace(L4, state_delay_ms=150.0))
    assert send.payload.flows == (VIDEO, replace(STATE, impairment=Impairment(150.0)))


def test_a_repeated_request_renews_the_lease() -> None:
    """A repeated request for a condition in force is granted at once and renews the lease."""
    node = server_with_condition()
    assert node.next_wake_ns() == at(5 * NS_PER_S).mono_ns
    assert reply_reasons(request(node, L4, 3 * NS_PER_S)) == [GRANTED]
    deliver(node, WAKE, None, at(5 * NS_PER_S))
    assert node.counts["netem_leases_ended"] == 0


def test_an_expired_lease_clears_the_queues() -> None:
    """An expired lease clears the queues, and another client may request a condition."""
    node = server_with_condition()
    bob = replace(L4, who="bob", instance=8)
    [reason] = reply_reasons(request(node, bob, NS_PER_S))
    assert "alice" in reason
    assert deliver(node, WAKE, None, at(LEASE_MS * NS_PER_MS)) == [Send("inject", InjectionOrder(2, "", ()))]
    sends = deliver(node, "injected", InjectionResult(2, "", "", ()), at(LEASE_MS * NS_PER_MS + 1))
    assert payloads(sends, "injection") == [
        InjectionSample(at(LEASE_MS * NS_PER_MS + 1).mono_ns, "", "", 0.0, None, "")
    ]
    assert node.next_wake_ns() is None
    assert payloads(request(node, bob, 6 * NS_PER_S), "inject") == [InjectionOrder(3, "L4", (VIDEO, STATE))]


def test_a_condition_is_changed_live() -> None:
    """A changed condition is applied without clearing the queues in between."""
    [send] = request(server_with_condition(), replace(L4, condition="L5", delay_ms=225.0), NS_PER_S)
    assert send == Send("inject", InjectionOrder(2, "L5", (replace(VIDEO, impairment=Impairment(225.0)), STATE)))


def test_a_condition_in_force_is_measured_periodically() -> None:
    """A condition in force is measured and recorded every five seconds."""
    node = server_with_condition()
    request(node, L4, 4 * NS_PER_S)
    again = deliver(node, WAKE, None, at(5 * NS_PER_S))
    assert again == [Send("inject", InjectionOrder(1, "L4", (VIDEO, STATE)))]
    assert len(payloads(deliver_result(node, 1, after_ns=6 * NS_PER_S), "injection")) == 2


@pytest.mark.parametrize(
    ("settings", "status", "expected_word"),
    [
        ({"allowed": False}, StationaryStatus(True, None), "injection.remote"),
        ({"simulated": False}, StationaryStatus(False, None), "stationary"),
        ({}, StationaryStatus(True, ("bob", 8)), "bob"),
    ],
)
def test_a_request_is_rejected_with_a_reason(
    settings: dict[str, bool], status: StationaryStatus, expected_word: str
) -> None:
    """A request is rejected if the config forbids it, a real vehicle drives, or another client has control."""
    node = server(**settings)
    deliver_status(node, status)
    sends = request(node, L4)
    [reason] = reply_reasons(sends)
    assert expected_word in reason
    assert payloads(sends, "inject") == []


def test_a_real_vehicle_gets_a_condition_at_standstill_only() -> None:
    """A real vehicle gets a condition only at standstill; while it drives, only the lease can be renewed."""
    node = server(simulated=False)
    assert reply_reasons(request(node, L4)) != [GRANTED]
    deliver_status(node, StationaryStatus(True, ("alice", 7)))
    request(node, L4)
    deliver_result(node, 1)
    deliver_status(node, StationaryStatus(False, ("alice", 7)))
    assert reply_reasons(request(node, L4, NS_PER_S)) == [GRANTED]
    [reason] = reply_reasons(request(node, replace(L4, delay_ms=0.0), NS_PER_S))
    assert "stationary" in reason


def test_a_deviating_measurement_is_recorded() -> None:
    """A measurement that deviates from the request is recorded, and the condition stays in force."""
    node = server_with_condition()
    sends = deliver(node, "injected", InjectionResult(1, "", "video was late", (("video", 155.0),)), at(NS_PER_S))
    assert payloads(sends, "injection")[0].reason == "video was late"
    assert reply_reasons(request(node, L4, NS_PER_S)) == [GRANTED]


def test_failed_queues_are_cleared_and_end_the_lease() -> None:
    """If the queues fail, the client receives the reason, the queues are cleared, and the lease ends."""
    node = server()
    request(node, L4)
    sends = deliver_result(node, 1, reason="there is no tc")
    assert reply_reasons(sends) == ["there is no tc"]
    assert {sample.reason for sample in payloads(sends, "injection")} == {"there is no tc"}
    assert payloads(sends, "inject") == [InjectionOrder(2, "", ())]
    assert payloads(request(node, replace(L4, who="bob")), "inject") == [InjectionOrder(3, "L4", (VIDEO, STATE))]


def test_a_failed_clearing_is_repeated() -> None:
    """A failed clearing of the queues is repeated every second."""
    node = server_with_condition()
    deliver(node, WAKE, None, at(5 * NS_PER_S))
    assert deliver_result(node, 2, reason="tc hangs", after_ns=6 * NS_PER_S)
    assert node.next_wake_ns() == at(7 * NS_PER_S).mono_ns
    assert deliver(node, WAKE, None, at(7 * NS_PER_S)) == [Send("inject", InjectionOrder(3, "", ()))]
    deliver(node, "injected", InjectionResult(3, "", "", ()), at(8 * NS_PER_S))
    assert node.next_wake_ns() is None


def test_the_lease_ends_when_another_client_acquires_control() -> None:
    """The lease ends when another client acquires control of the vehicle."""
    node = server_with_condition()
    assert deliver_status(node, StationaryStatus(True, None)) == []
    assert deliver_status(node, StationaryStatus(True, ("alice", 7))) == []
    assert deliver_status(node, StationaryStatus(True, ("bob", 8))) == [Send("inject", InjectionOrder(2, "", ()))]


def test_an_impossible_impairment_is_rejected() -> None:
    """An impairment that netem cannot apply is rejected, and the condition in force stays."""
    node = server_with_condition()
    [reason] = reply_reasons(request(node, replace(L4, condition="wild", delay_ms=10.0, jitter_ms=20.0)))
    assert reason.startswith("video: ")
    assert "20 ms" in reason
    assert reply_reasons(request(node, L4, NS_PER_S)) == [GRANTED]


def test_the_result_of_a_replaced_order_is_ignored() -> None:
    """The result of a replaced order is ignored; the result of the newest order answers all requests."""
    node = server()
    request(node, L4)
    request(node, replace(L4, condition="L5", delay_ms=225.0))
    assert deliver_result(node, 1) == []
    assert reply_reasons(deliver_result(node, 2)) == [GRANTED, GRANTED]


def test_a_long_reason_is_shortened() -> None:
    """A long reason is shortened so that the reply can be decoded, also if its letters have two bytes in UTF-8."""
    node = server()
    request(node, L4)
    (reason,) = reply_reasons(deliver_result(node, 1, 300 * "ä"))
    assert reason.startswith(190 * "ä")
    assert reason.endswith(ELLIPSIS)


def test_pending_requests_are_bounded() -> None:
    """Of the requests that wait for the queues, the last 64 are answered."""
    node = server()
    for peer in range(1000):
        request(node, replace(L4, delay_ms=float(peer)), peer=peer)
    replies = [send.peer for send in deliver_result(node, 1000) if send.channel == "netem_reply"]
    assert replies == list(range(1000 - 64, 1000))


def test_garbage_is_counted() -> None:
    """Unreadable requests and replies are counted and have no effect."""
    node, client = server(), new_client()
    assert deliver(node, "netem", b"\x93garbage", at(0), 1) == []
    assert node.counts["netem_requests_unreadable"] == 1
    assert deliver(client, "netem_reply", b"", at(0)) == []
    assert client.counts["netem_replies_unreadable"] == 1


# The client.


def new_client(control: ImpairedFlow = CONTROL) -> InjectionClient:
    return InjectionClient(
        "alice", 7, condition="L4", control=control, video=VIDEO.impairment, state_delay_ms=0.0, start_ns=at(0).mono_ns
    )


def test_the_client_delays_its_control_first() -> None:
    """The client first delays the control on its own machine, then requests the condition once a second."""
    client = new_client()
    assert client.next_wake_ns() == at(0).mono_ns
    assert deliver(client, WAKE, None, at(0)) == [Send("inject", InjectionOrder(1, "L4", (CONTROL,)))]
    assert payloads(deliver(client, WAKE, None, at(NS_PER_S)), "netem") == []
    deliver(client, "injected", InjectionResult(1, "", "", (("control", 75.1),)), at(NS_PER_S))
    [payload] = payloads(deliver(client, WAKE, None, at(NS_PER_S)), "netem")
    assert decode(NetemRequest, payload) == L4
    assert client.next_wake_ns() == at(2 * NS_PER_S).mono_ns
    granted = deliver(client, "netem_reply", encode(NetemReply(True, "")), at(NS_PER_S))
    assert granted == [Send("condition_in_force", "")]
    assert len(payloads(deliver(client, WAKE, None, at(2 * NS_PER_S)), "netem")) == 1


def test_a_failed_order_of_the_client_is_repeated() -> None:
    """If the client's machine cannot delay the control, the driver gets the reason, and the order is repeated."""
    client = new_client()
    deliver(client, WAKE, None, at(0))
    sends = deliver(client, "injected", InjectionResult(1, "no tc", "", ()), at(0))
    [reason] = payloads(sends, "condition_in_force")
    assert reason.endswith(": no tc")
    assert payloads(deliver(client, WAKE, None, at(NS_PER_S)), "inject") == [InjectionOrder(2, "L4", (CONTROL,))]


def test_a_rejection_is_reported_to_the_driver() -> None:
    """The driver receives the server's reason for a rejection."""
    client = new_client()
    deliver(client, WAKE, None, at(0))
    deliver(client, "injected", InjectionResult(1, "", "", ()), at(0))
    rejected = deliver(client, "netem_reply", encode(NetemReply(False, "no")), at(0))
    [reason] = payloads(rejected, "condition_in_force")
    assert reason.endswith(": no")


def test_without_a_condition_nothing_is_requested() -> None:
    """A client without a condition never wakes, so it requests nothing."""
    client = InjectionClient(
        "alice", 7, condition="", control=CONTROL, video=Impairment(), state_delay_ms=0.0, start_ns=0
    )
    assert client.next_wake_ns() is None
