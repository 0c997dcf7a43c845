from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from tests.nodes.stand_ins import at, give, of

from lavt.domain import NS_PER_MS, NS_PER_S, NetemReply, NetemRequest
from lavt.node import WAKE, Send
from lavt.nodes.injection import LEASE_MS, InjectionClient, InjectionNode
from lavt.nodes.payloads import InjectionSample, StationaryStatus
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.messages import decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult

L4 = NetemRequest("alice", 7, "L4", LEASE_MS, 150.0, 0.0, 0.0, "normal", 0.0, 0.0, 0, 0.0, 0.0)
VIDEO = ImpairedFlow("video", "udp", 5600, "source", Impairment(150.0))
STATE = ImpairedFlow("state", "udp", 7448, "source", Impairment())
CONTROL = ImpairedFlow("control", "udp", 7448, "destination", Impairment(75.0))
STANDS = StationaryStatus(True, None)


def server(*, allowed: bool = True, simulated: bool = True) -> InjectionNode:
    return InjectionNode(allowed=allowed, simulated=simulated, video_port=5600, control=("udp", 7448))


def ask(node: InjectionNode, request: NetemRequest, after_ns: int = 0, peer: Any = 1) -> list[Send]:
    return give(node, "netem", encode(request), at(after_ns), peer)


def done(node: InjectionNode | InjectionClient, number: int, reason: str = "", after_ns: int = 0) -> list[Send]:
    measured = () if reason else (("video", 150.2),)
    return give(node, "injected", InjectionResult(number, reason, "", measured), at(after_ns))


def rejections(sends: list[Send]) -> list[str]:
    replies = [decode(NetemReply, payload) for payload in of(sends, "netem_reply")]
    assert all(reply.granted == (reply.reason == "") for reply in replies)
    return [reply.reason for reply in replies]


def in_force(request: NetemRequest = L4) -> InjectionNode:
    node = server()
    ask(node, request)
    done(node, 1)
    return node


# The server.


def test_a_condition_is_granted_when_the_queues_do_it() -> None:
    """The server's queues are told, and whoever asked is answered when they have said that they do it."""
    node = server()
    assert ask(node, L4) == [Send("inject", InjectionOrder(1, "L4", (VIDEO, STATE)))]
    sends = done(node, 1)
    assert rejections(sends) == [""]
    assert [send.peer for send in sends if send.channel == "netem_reply"] == [1]
    assert of(sends, "injection") == [
        InjectionSample(at(0).mono_ns, "L4", "video", 150.0, 150.2, ""),
        InjectionSample(at(0).mono_ns, "L4", "state", 0.0, None, ""),
    ]


def test_the_state_goes_with_the_video_where_that_is_requested() -> None:
    """A state delay is that of what the server's router sends, from the port at which it listens."""
    [send] = ask(server(), replace(L4, state_delay_ms=150.0))
    assert send.payload.flows == (VIDEO, replace(STATE, impairment=Impairment(150.0)))


def test_asking_again_renews_the_lease_and_changes_nothing() -> None:
    """A condition in force is granted at once when it is asked for again, and its lease begins anew."""
    node = in_force()
    assert node.next_wake_ns() == at(5 * NS_PER_S).mono_ns
    assert rejections(ask(node, L4, 3 * NS_PER_S)) == [""]
    give(node, WAKE, None, at(5 * NS_PER_S))
    assert node.counts["netem_leases_ended"] == 0


def test_a_lease_that_is_not_renewed_clears_everything_and_somebody_else_may_ask() -> None:
    """After the lease the queues are put back, the record says so, and the condition is free for another client."""
    node = in_force()
    bob = replace(L4, who="bob", instance=8)
    assert rejections(ask(node, bob, NS_PER_S)) == ["alice has the condition in hand until its lease ends"]
    assert give(node, WAKE, None, at(LEASE_MS * NS_PER_MS)) == [Send("inject", InjectionOrder(2, "", ()))]
    sends = give(node, "injected", InjectionResult(2, "", "", ()), at(LEASE_MS * NS_PER_MS + 1))
    assert of(sends, "injection") == [InjectionSample(at(LEASE_MS * NS_PER_MS + 1).mono_ns, "", "", 0.0, None, "")]
    assert node.next_wake_ns() is None
    assert of(ask(node, bob, 6 * NS_PER_S), "inject") == [InjectionOrder(3, "L4", (VIDEO, STATE))]


def test_a_change_of_the_condition_is_made_live() -> None:
    """Another condition by the same client is told to the queues, which change without being cleared in between."""
    [send] = ask(in_force(), replace(L4, condition="L5", delay_ms=225.0), NS_PER_S)
    assert send == Send("inject", InjectionOrder(2, "L5", (replace(VIDEO, impairment=Impairment(225.0)), STATE)))


def test_what_is_in_force_is_measured_again_and_again() -> None:
    """Five seconds after a measurement the queues are measured again, with nothing changed, and the record has both."""
    node = in_force()
    ask(node, L4, 4 * NS_PER_S)
    again = give(node, WAKE, None, at(5 * NS_PER_S))
    assert again == [Send("inject", InjectionOrder(1, "L4", (VIDEO, STATE)))]
    assert len(of(done(node, 1, after_ns=6 * NS_PER_S), "injection")) == 2


@pytest.mark.parametrize(
    ("settings", "rest", "said"),
    [
        (
            {"allowed": False},
            STANDS,
            "this server lets nobody inject delay: set injection.remote: true in its config",
        ),
        (
            {"simulated": False},
            StationaryStatus(False, None),
            "a vehicle that is not simulated must stand disarmed for this",
        ),
        ({}, StationaryStatus(True, ("bob", 8)), "bob holds the vehicle"),
    ],
)
def test_it_rejects_with_a_reason(settings: dict[str, bool], rest: StationaryStatus, said: str) -> None:
    """No condition is applied unless the config allows it, for a real vehicle that drives, or under another's drive."""
    node = server(**settings)
    give(node, "rest", rest, at(0))
    sends = ask(node, L4)
    assert rejections(sends) == [said]
    assert of(sends, "inject") == []


def test_a_real_vehicle_that_stands_may_have_its_network_changed_and_keeps_it_while_it_drives() -> None:
    """At standstill and disarmed a condition is applied to a real vehicle; driving it renews, but changes nothing."""
    node = server(simulated=False)
    assert rejections(ask(node, L4)) == ["a vehicle that is not simulated must stand disarmed for this"]
    give(node, "rest", StationaryStatus(True, ("alice", 7)), at(0))
    ask(node, L4)
    done(node, 1)
    give(node, "rest", StationaryStatus(False, ("alice", 7)), at(0))
    assert rejections(ask(node, L4, NS_PER_S)) == [""]
    assert rejections(ask(node, replace(L4, delay_ms=0.0), NS_PER_S)) == [
        "a vehicle that is not simulated must stand disarmed for this"
    ]


def test_what_is_measured_otherwise_than_requested_is_written_down_and_changes_nothing() -> None:
    """A measurement that is not as asked goes into the record; the condition stays in force."""
    node = in_force()
    sends = give(node, "injected", InjectionResult(1, "", "video was late", (("video", 155.0),)), at(NS_PER_S))
    assert of(sends, "injection")[0].reason == "video was late"
    assert rejections(ask(node, L4, NS_PER_S)) == [""]


def test_queues_that_fail_are_told_and_put_back_and_the_lease_is_free() -> None:
    """Where the queues cannot do it, whoever asked hears why, what was done is undone, and anybody may ask again."""
    node = server()
    ask(node, L4)
    sends = done(node, 1, reason="there is no tc")
    assert rejections(sends) == ["there is no tc"]
    assert {sample.reason for sample in of(sends, "injection")} == {"there is no tc"}
    assert of(sends, "inject") == [InjectionOrder(2, "", ())]
    assert of(ask(node, L4), "inject") == [InjectionOrder(3, "L4", (VIDEO, STATE))]
    assert of(ask(server(), replace(L4, who="bob")), "netem_reply") == []


def test_what_cannot_be_put_back_is_tried_again_every_second() -> None:
    """A queue that could not be cleared at the lease's end is told again until it is."""
    node = in_force()
    give(node, WAKE, None, at(5 * NS_PER_S))
    assert done(node, 2, reason="tc hangs", after_ns=6 * NS_PER_S)
    assert node.next_wake_ns() == at(7 * NS_PER_S).mono_ns
    assert give(node, WAKE, None, at(7 * NS_PER_S)) == [Send("inject", InjectionOrder(3, "", ()))]
    give(node, "injected", InjectionResult(3, "", "", ()), at(8 * NS_PER_S))
    assert node.next_wake_ns() is None


def test_who_comes_to_hold_the_vehicle_drives_without_anothers_condition() -> None:
    """When another client holds the vehicle the lease ends; when its own does, or nobody, it goes on."""
    node = in_force()
    assert give(node, "rest", StationaryStatus(True, None), at(0)) == []
    assert give(node, "rest", StationaryStatus(True, ("alice", 7)), at(0)) == []
    assert give(node, "rest", StationaryStatus(True, ("bob", 8)), at(0)) == [Send("inject", InjectionOrder(2, "", ()))]


def test_a_law_that_netem_cannot_do_is_rejected_before_anything_is_touched() -> None:
    """What no queue could do is refused with the reason, and the condition in force stays."""
    node = in_force()
    [reason] = rejections(ask(node, replace(L4, condition="wild", delay_ms=10.0, jitter_ms=20.0)))
    assert reason.startswith("video: ")
    assert "20 ms" in reason
    assert rejections(ask(node, L4, NS_PER_S)) == [""]


def test_what_the_queues_say_of_an_older_order_is_not_taken_for_the_newer() -> None:
    """An answer to an order that was replaced grants nothing."""
    node = server()
    ask(node, L4)
    ask(node, replace(L4, condition="L5", delay_ms=225.0))
    assert done(node, 1) == []
    assert rejections(done(node, 2)) == ["", ""]


def test_a_flood_of_questions_is_not_kept() -> None:
    """Of those who ask while the queues are busy the last 64 are answered, as many as the link still knows."""
    node = server()
    for peer in range(1000):
        ask(node, replace(L4, delay_ms=float(peer)), peer=peer)
    replies = [send.peer for send in done(node, 1000) if send.channel == "netem_reply"]
    assert replies == list(range(1000 - 64, 1000))


def test_garbage_is_counted() -> None:
    """Bytes that are no request, and no reply, are counted and change nothing."""
    node, client = server(), asking()
    assert give(node, "netem", b"\x93garbage", at(0), 1) == []
    assert node.counts["netem_requests_unreadable"] == 1
    assert give(client, "netem_reply", b"", at(0)) == []
    assert client.counts["netem_replies_unreadable"] == 1


# The client.


def asking(control: ImpairedFlow = CONTROL) -> InjectionClient:
    return InjectionClient(
        "alice", 7, condition="L4", control=control, video=VIDEO.impairment, state_delay_ms=0.0, start_ns=at(0).mono_ns
    )


def test_the_client_delays_its_own_control_first_and_then_asks_once_a_second() -> None:
    """The server is asked when this machine's queue is in force, and once a second from then on; then it may begin."""
    client = asking()
    assert client.next_wake_ns() == at(0).mono_ns
    assert give(client, WAKE, None, at(0)) == [Send("inject", InjectionOrder(1, "L4", (CONTROL,)))]
    assert of(give(client, WAKE, None, at(NS_PER_S)), "netem") == []
    give(client, "injected", InjectionResult(1, "", "", (("control", 75.1),)), at(NS_PER_S))
    [payload] = of(give(client, WAKE, None, at(NS_PER_S)), "netem")
    assert decode(NetemRequest, payload) == L4
    assert client.next_wake_ns() == at(2 * NS_PER_S).mono_ns
    granted = give(client, "netem_reply", encode(NetemReply(True, "")), at(NS_PER_S))
    assert granted == [Send("condition_in_force", "")]
    assert len(of(give(client, WAKE, None, at(2 * NS_PER_S)), "netem")) == 1


def test_a_client_whose_own_queue_fails_says_so_and_tries_again() -> None:
    """Where this machine cannot delay the control the driver is told why, and a second later it is tried again."""
    client = asking()
    give(client, WAKE, None, at(0))
    sends = give(client, "injected", InjectionResult(1, "no tc", "", ()), at(0))
    assert of(sends, "condition_in_force") == ["this machine does not delay the control: no tc"]
    assert of(give(client, WAKE, None, at(NS_PER_S)), "inject") == [InjectionOrder(2, "L4", (CONTROL,))]


def test_a_rejection_is_told_to_the_driver() -> None:
    """Where the server refuses, the driver is told why, and the server is asked again."""
    client = asking()
    give(client, WAKE, None, at(0))
    give(client, "injected", InjectionResult(1, "", "", ()), at(0))
    rejected = give(client, "netem_reply", encode(NetemReply(False, "no")), at(0))
    assert rejected == [Send("condition_in_force", "the server does not delay the video: no")]


def test_without_a_condition_nothing_is_requested() -> None:
    """A client without a condition never wakes for it."""
    client = InjectionClient(
        "alice", 7, condition="", control=CONTROL, video=Impairment(), state_delay_ms=0.0, start_ns=0
    )
    assert client.next_wake_ns() is None
