from __future__ import annotations

from tests.nodes.stand_ins import MONO_NS, at, give

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.node import WAKE, Send
from lavt.nodes.clock_sync import ClockSyncNode
from lavt.nodes.reports import ClockSample
from lavt.transport.clock_offset import ClockReport


def test_it_asks_once_a_second() -> None:
    """The host's source of time is asked at the start and every second from then on, without catching up."""
    node = ClockSyncNode(MONO_NS)
    assert node.next_wake_ns() == MONO_NS
    assert give(node, WAKE, None, at(0)) == [Send("clock_query", None)]
    assert node.next_wake_ns() == at(NS_PER_S).mono_ns
    give(node, WAKE, None, at(7 * NS_PER_S))
    assert node.next_wake_ns() == at(8 * NS_PER_S).mono_ns


def test_being_late_does_not_add_up() -> None:
    """A node that is woken late asks by the same grid of seconds as ever, and leaves out the ticks that it missed."""
    node = ClockSyncNode(MONO_NS)
    for late_ms, next_s in ((400, 1), (1_400, 2), (4_900, 5), (5_000, 6)):
        give(node, WAKE, None, at(late_ms * NS_PER_MS))
        assert node.next_wake_ns() == at(next_s * NS_PER_S).mono_ns


def test_a_report_is_paired_with_both_clocks() -> None:
    """What the source says is written down beside a reading of both clocks, also where it knows no bound."""
    report = ClockReport("kernel", "chrony", 0.25, None)
    now = at(5, 99)
    (send,) = give(ClockSyncNode(MONO_NS), "clock_report", report, now)
    assert send == Send("clock", ClockSample(now.mono_ns, now.wall_ns, "kernel", "chrony", 0.25, None))
