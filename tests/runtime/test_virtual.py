from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.node import WAKE, Message, Send, Stage
from lavt.runtime.virtual import Cost, HostClock, VirtualHost, VirtualLink, VirtualRuntime, modelled_clock_source
from lavt.streams import QuantileStream
from lavt.transport.emulation.delay_line import DelayLine, DelayModel, Lognormal

MS = NS_PER_MS


class PeriodicSender:
    """A node that sends a numbered message every period and stores received ones."""

    def __init__(self, name: str, sends: str, receives: str, *, start_ns: int, period_ns: int | None) -> None:
        self.name, self.counts = name, Counter[str]()
        self.received: list[tuple[Any, int, int]] = []
        """Payload, time of arrival and time when its stage began, of each message."""
        self._sends, self._next, self._period_ns = sends, start_ns, period_ns
        self._number = 0
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            WAKE: (("send", self._send),),
            receives: (("receive", self._receive),),
        }

    def next_wake_ns(self) -> int | None:
        """Return when the next message is due."""
        return None if self._period_ns is None else self._next

    def _send(self, _message: Message, _now: Now) -> list[Send]:
        assert self._period_ns is not None
        self._next += self._period_ns
        self._number += 1
        return [Send(self._sends, self._number.to_bytes(2, "big"))]

    def _receive(self, message: Message, now: Now) -> None:
        self.received.append((message.payload, message.arrived.mono_ns, now.mono_ns))


class NullRecorder:
    """A recorder that drops its entries."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Drop one entry."""


def new_runtime(
    delay: DelayModel, *, costs_ns: Mapping[tuple[str, str], Cost] | None = None, period_ns: int = 20 * MS
) -> tuple[VirtualRuntime, PeriodicSender]:
    """Return a runtime in which a driver sends `control` to an actuator."""
    clock = HostClock(0, 0)
    driver = PeriodicSender("driver", "control", "state", start_ns=0, period_ns=period_ns)
    actuator = PeriodicSender("actuator", "state", "control", start_ns=0, period_ns=None)
    hosts = [
        VirtualHost(side, clock, [node], NullRecorder(), costs_ns or {}, modelled_clock_source(clock, side, 0, 0))
        for side, node in (("client", driver), ("server", actuator))
    ]
    link = VirtualLink(DelayLine(delay), lambda _payload, count: count)
    return VirtualRuntime(hosts, {"control": link}), actuator


@given(st.integers(0, 10**13), st.integers(0, 10**13), st.integers(-500_000, 500_000), st.integers(-(10**9), 10**9))
def test_a_hosts_clock_is_inverted_exactly(start_ns: int, mono_ns: int, drift_ppb: int, step_ns: int) -> None:
    """`true_ns` is the first true time at which the clock has reached a value, for any drift and steps."""
    clock = HostClock(start_ns, 0, drift_ppb=drift_ppb, steps=[(5 * NS_PER_S, step_ns)])
    true_ns = clock.true_ns(start_ns + mono_ns)
    assert clock.now_at(true_ns).mono_ns >= start_ns + mono_ns
    assert clock.now_at(true_ns - 1).mono_ns < start_ns + mono_ns


def test_offset_drift_and_steps() -> None:
    """The wall clock has an offset and steps, and both clocks drift."""
    clock = HostClock(7, 100, offset_ns=50, drift_ppb=1000, steps=[(2 * NS_PER_S, -30)])
    assert clock.now_at(0) == Now(7, 150)
    assert clock.now_at(NS_PER_S) == Now(NS_PER_S + 1007, NS_PER_S + 1150)
    assert clock.now_at(2 * NS_PER_S) == Now(2 * NS_PER_S + 2007, 2 * NS_PER_S + 2120)
    assert modelled_clock_source(clock, "host", 1e-6, 2e-6)(NS_PER_S).correction_s == pytest.approx(-1050e-9 + 1e-6)


def test_links_delay_exactly_and_keep_order() -> None:
    """A link with a constant delay delays exactly; a link with jitter keeps the order."""
    runtime, actuator = new_runtime(DelayModel(75.0))
    runtime.run(NS_PER_S, lambda: False)
    assert [arrived for _, arrived, _ in actuator.received] == [(20 * i + 75) * MS for i in range(47)]
    runtime, actuator = new_runtime(DelayModel(0.0, Lognormal(40.0, 1.0), 1, "jitter"))
    runtime.run(2 * NS_PER_S, lambda: False)
    numbers = [payload for payload, _, _ in actuator.received]
    arrivals = [arrived for _, arrived, _ in actuator.received]
    assert numbers == sorted(numbers)
    assert arrivals == sorted(arrivals)
    assert len({late - early for early, late in pairwise(arrivals)}) > 10


def test_a_busy_node_queues_messages() -> None:
    """If a node takes longer than the interval of its messages, messages wait, each with its time of arrival."""
    runtime, actuator = new_runtime(
        DelayModel(0.0), costs_ns={("actuator", "receive"): 30 * MS, ("driver", "send"): 3 * MS}
    )
    runtime.run(200 * MS, lambda: False)
    assert [arrived // MS for _, arrived, _ in actuator.received[:4]] == [3, 23, 43, 63]
    assert [started // MS for _, _, started in actuator.received[:4]] == [3, 33, 63, 93]


def drawn(name: str, longest_ms: int) -> QuantileStream:
    return QuantileStream(1, name, [0.0, 0.9, 1.0], [0.0, 2.0 * MS, float(longest_ms * MS)])


def test_drawn_costs_keep_the_order() -> None:
    """If stages and links take random times, messages differ in their times but never overtake each other."""
    costs_ns = {("driver", "send"): drawn("send", 15), ("actuator", "wait_control"): drawn("wait", 60)}
    runtime, actuator = new_runtime(DelayModel(5.0, measured_ns=drawn("link", 90)), costs_ns=costs_ns)
    runtime.run(4 * NS_PER_S, lambda: False)
    numbers = [int.from_bytes(payload, "big") for payload, _, _ in actuator.received]
    assert numbers == list(range(1, len(numbers) + 1))
    for times in zip(*((arrived, began) for _, arrived, began in actuator.received), strict=True):
        assert list(times) == sorted(times)
    waits_ms = [(began - arrived) / MS for _, arrived, began in actuator.received]
    assert len(set(waits_ms)) > 100
    assert max(waits_ms) > 10


def test_drawn_costs_do_not_depend_on_the_network() -> None:
    """A message has the same drawn costs whatever the delay of the link."""

    def waits_ns(delay_ms: float) -> list[int]:
        runtime, actuator = new_runtime(
            DelayModel(delay_ms), costs_ns={("actuator", "wait_control"): drawn("wait", 15)}
        )
        runtime.run(2 * NS_PER_S, lambda: False)
        return [began - arrived for _, arrived, began in actuator.received]

    near, far = waits_ns(0.0), waits_ns(700.0)
    assert len(set(far)) > 50
    assert near[: len(far)] == far


def test_a_closed_link_loses_messages() -> None:
    """A closed link loses the messages that are sent while it is closed, and no others."""
    runtime, actuator = new_runtime(DelayModel(50.0))
    link = runtime.links["control"]
    runtime.call_at(110 * MS, lambda: setattr(link, "open", False))
    runtime.call_at(210 * MS, lambda: setattr(link, "open", True))
    runtime.run(400 * MS, lambda: False)
    numbers = [int.from_bytes(payload, "big") for payload, _, _ in actuator.received]
    assert numbers == [1, 2, 3, 4, 5, 6, 12, 13, 14, 15, 16, 17, 18]


def test_two_runs_are_equal() -> None:
    """Two runs with the same seed have the same times, to the nanosecond; another seed gives other times."""

    def received(seed: int) -> list[tuple[Any, int, int]]:
        runtime, actuator = new_runtime(DelayModel(5.0, Lognormal(12.0, 0.6), seed, "jitter"))
        runtime.run(NS_PER_S, lambda: False)
        return actuator.received

    assert received(1) == received(1)
    assert received(1) != received(2)


def test_a_run_ends_when_finished() -> None:
    """A run ends when it is finished or at its limit, and returns whether it is finished."""
    runtime, actuator = new_runtime(DelayModel(0.0))
    assert runtime.run(NS_PER_S, lambda: len(actuator.received) == 3)
    assert runtime.true_ns == 40 * MS
    assert not runtime.run(100 * MS, lambda: False)
    assert runtime.true_ns == 100 * MS


def test_a_message_can_be_delivered_before_waiting_ones() -> None:
    """`deliver_first` runs the receiver's pipeline before the waiting messages, which wait until its end."""
    runtime, actuator = new_runtime(DelayModel(0.0), costs_ns={("actuator", "receive"): 30 * MS})
    runtime.call_at(60 * MS, runtime.deliver_first, "server", "control", b"first")  # when 3 and 4 wait
    runtime.run(130 * MS, lambda: False)
    assert [(payload, began // MS) for payload, _, began in actuator.received[1:5]] == [
        ((2).to_bytes(2, "big"), 30),
        (b"first", 60),
        ((3).to_bytes(2, "big"), 90),
        ((4).to_bytes(2, "big"), 120),
    ]


def test_no_message_is_delivered_into_a_pipeline() -> None:
    """`deliver_first` is an error while the receiver is in the middle of a pipeline."""
    runtime, _ = new_runtime(DelayModel(0.0), costs_ns={("actuator", "receive"): 30 * MS})
    runtime.run(NS_PER_S, lambda: runtime.true_ns == 40 * MS)
    with pytest.raises(RuntimeError, match="in the middle of a pipeline"):
        runtime.deliver_first("server", "control", b"first")
