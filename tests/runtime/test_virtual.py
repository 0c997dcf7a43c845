from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.node import WAKE, Hop, Message, Send
from lavt.runtime.virtual import HostClock, VirtualHost, VirtualLink, VirtualRuntime, modelled_clock_source
from lavt.transport.emulation.delay_line import DelayLine, DelayModel, Lognormal

MS = NS_PER_MS


class Talker:
    """A node that says a numbered message every period and notes what it hears."""

    def __init__(self, name: str, says: str, hears: str, *, start_ns: int, period_ns: int | None) -> None:
        self.name, self.counts = name, Counter[str]()
        self.heard: list[tuple[Any, int, int]] = []
        self._says, self._next, self._period_ns = says, start_ns, period_ns
        self._number = 0
        self.chains: Mapping[str, Sequence[Hop]] = {WAKE: (("say", self._say),), hears: (("hear", self._hear),)}

    def next_wake_ns(self) -> int | None:
        """When it speaks next."""
        return None if self._period_ns is None else self._next

    def _say(self, _message: Message, _now: Now) -> list[Send]:
        assert self._period_ns is not None
        self._next += self._period_ns
        self._number += 1
        return [Send(self._says, self._number.to_bytes(2, "big"))]

    def _hear(self, message: Message, now: Now) -> None:
        self.heard.append((message.payload, message.arrived.mono_ns, now.mono_ns))


class Nothing:
    """A recorder that keeps nothing."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Forget one entry."""


def talk(
    law: DelayModel, *, costs_ns: Mapping[tuple[str, str], int] | None = None, period_ns: int = 20 * MS
) -> tuple[VirtualRuntime, Talker]:
    """Let a driver say `control` to an actuator."""
    clock = HostClock(0, 0)
    driver = Talker("driver", "control", "state", start_ns=0, period_ns=period_ns)
    actuator = Talker("actuator", "state", "control", start_ns=0, period_ns=None)
    hosts = [
        VirtualHost(side, clock, [node], Nothing(), costs_ns or {}, modelled_clock_source(clock, side, 0, 0))
        for side, node in (("client", driver), ("server", actuator))
    ]
    link = VirtualLink(DelayLine(law), lambda _payload, count: count)
    return VirtualRuntime(hosts, {"control": link}), actuator


@given(st.integers(0, 10**13), st.integers(0, 10**13), st.integers(-500_000, 500_000), st.integers(-(10**9), 10**9))
def test_a_hosts_clock_is_inverted_exactly(start_ns: int, mono_ns: int, drift_ppb: int, step_ns: int) -> None:
    """`true_ns` is the first true time at which the clock shows it, whatever drift and steps."""
    clock = HostClock(start_ns, 0, drift_ppb=drift_ppb, steps=[(5 * NS_PER_S, step_ns)])
    true_ns = clock.true_ns(start_ns + mono_ns)
    assert clock.at(true_ns).mono_ns >= start_ns + mono_ns
    assert clock.at(true_ns - 1).mono_ns < start_ns + mono_ns


def test_offset_drift_and_steps_are_those_requested_for() -> None:
    """The wall clock has its offset, both clocks drift, and a step moves the wall clock alone, at its time."""
    clock = HostClock(7, 100, offset_ns=50, drift_ppb=1000, steps=[(2 * NS_PER_S, -30)])
    assert clock.at(0) == Now(7, 150)
    assert clock.at(NS_PER_S) == Now(NS_PER_S + 1007, NS_PER_S + 1150)
    assert clock.at(2 * NS_PER_S) == Now(2 * NS_PER_S + 2007, 2 * NS_PER_S + 2120)
    assert modelled_clock_source(clock, "host", 1e-6, 2e-6)(NS_PER_S).correction_s == pytest.approx(-1050e-9 + 1e-6)


def test_links_delay_exactly_and_keep_order() -> None:
    """A constant link delays by its constant; one with jitter lets nothing overtake."""
    runtime, actuator = talk(DelayModel(75.0))
    runtime.run(NS_PER_S, lambda: False)
    assert [arrived for _, arrived, _ in actuator.heard] == [(20 * i + 75) * MS for i in range(47)]
    runtime, actuator = talk(DelayModel(0.0, Lognormal(40.0, 1.0), 1, "jitter"))
    runtime.run(2 * NS_PER_S, lambda: False)
    numbers = [payload for payload, _, _ in actuator.heard]
    arrivals = [arrived for _, arrived, _ in actuator.heard]
    assert numbers == sorted(numbers)
    assert arrivals == sorted(arrivals)
    assert len({late - early for early, late in pairwise(arrivals)}) > 10


def test_costs_add_up_and_a_busy_node_queues() -> None:
    """A hop that takes 30 ms delays what comes every 20 ms more each time; messages wait with their own arrival."""
    runtime, actuator = talk(DelayModel(0.0), costs_ns={("actuator", "hear"): 30 * MS, ("driver", "say"): 3 * MS})
    runtime.run(200 * MS, lambda: False)
    assert [arrived // MS for _, arrived, _ in actuator.heard[:4]] == [3, 23, 43, 63]
    assert [begun // MS for _, _, begun in actuator.heard[:4]] == [3, 33, 63, 93]


def test_a_closed_link_loses() -> None:
    """What is sent over a closed link never arrives; what was under way does, and so does what comes after."""
    runtime, actuator = talk(DelayModel(50.0))
    link = runtime.links["control"]
    runtime.at(110 * MS, lambda: setattr(link, "open", False))
    runtime.at(210 * MS, lambda: setattr(link, "open", True))
    runtime.run(400 * MS, lambda: False)
    numbers = [int.from_bytes(payload, "big") for payload, _, _ in actuator.heard]
    assert numbers == [1, 2, 3, 4, 5, 6, 12, 13, 14, 15, 16, 17, 18]


def test_two_runs_are_equal() -> None:
    """The same seed gives the same times to the nanosecond; another seed gives others."""

    def heard(seed: int) -> list[tuple[Any, int, int]]:
        runtime, actuator = talk(DelayModel(5.0, Lognormal(12.0, 0.6), seed, "jitter"))
        runtime.run(NS_PER_S, lambda: False)
        return actuator.heard

    assert heard(1) == heard(1)
    assert heard(1) != heard(2)


def test_it_ends_when_finished() -> None:
    """A run ends as soon as it is finished, or at its limit, and tells which."""
    runtime, actuator = talk(DelayModel(0.0))
    assert runtime.run(NS_PER_S, lambda: len(actuator.heard) == 3)
    assert runtime.true_ns == 40 * MS
    assert not runtime.run(100 * MS, lambda: False)
    assert runtime.true_ns == 100 * MS
