from __future__ import annotations

import queue
import threading
from collections.abc import Sequence
from typing import Any

from lavt.clock import MachineClock
from lavt.domain import Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment
from lavt.transport.netem.injector import InjectionOrder, InjectionResult, Injector
from lavt.transport.netem.netem import Verification
from lavt.transport.netem.probe import ProbeResult

VIDEO = ImpairedFlow("video", "udp", 5600, "source", Impairment(150.0))
NOTHING = ImpairedFlow("video", "udp", 5600, "source", Impairment())
PROBE = ExemptPort("udp", 5602, "the clock probe")
FOUND = {"video": ProbeResult(10, 0, 0, 0, 150.0, 150.1, 150.2)}
ANSWERS_S = 10.0


class NamedQueues:
    """A stand-in for the kernel's queues, which have tests of their own in `tests/kernel`."""

    def __init__(self, failure: Exception | None = None, problems: tuple[str, ...] = ()) -> None:
        self.did: list[Any] = []
        self.begun, self.go = threading.Event(), threading.Event()
        self.go.set()
        self._failure = failure
        self._problems = problems

    def apply(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], condition: str) -> None:
        """Note it, when it may, or fail."""
        self.begun.set()
        self.go.wait(ANSWERS_S)
        if self._failure:
            raise self._failure
        self.did.append((condition, tuple(flows), tuple(exempt)))

    def verify(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int) -> Verification:
        """Give what is always found, beside what is asked about."""
        self.did.append(("verify", tuple(flows), tuple(exempt), count))
        return Verification(list(self._problems), FOUND)

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int
    ) -> dict[str, ProbeResult]:
        """Give the same."""
        self.did.append(("measure", tuple(flows), tuple(exempt), count))
        return FOUND

    def problems(self) -> list[str]:
        """Have one."""
        return ["its jitter has stopped"]

    def clear(self) -> None:
        """Note it."""
        self.did.append("clear")


class Told:
    """An injector, and what it says."""

    def __init__(self, queues: NamedQueues | None) -> None:
        self.said: queue.Queue[InjectionResult] = queue.Queue()
        self.injector = Injector(MachineClock(), self._deliver, queues, [PROBE])

    def _deliver(self, _channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        self.said.put(payload)

    def order(self, order: InjectionOrder) -> InjectionResult:
        """Give an order and wait for its answer."""
        self.injector.send(Send("inject", order))
        return self.said.get(timeout=ANSWERS_S)


def ordered(queues: NamedQueues | None, *orders: InjectionOrder) -> list[InjectionResult]:
    """Give what an injector says of orders, one after the other, having been closed."""
    told = Told(queues)
    answers = [told.order(order) for order in orders]
    told.injector.close()
    return answers


def test_an_order_is_applied_once_and_measured_whenever_it_comes() -> None:
    """An order is applied and verified, and when it comes again measured; one without flows clears, as the end does."""
    queues = NamedQueues()
    said = ordered(
        queues, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "", ())
    )
    assert said[0] == InjectionResult(1, "", "", (("video", 150.1),))
    assert (said[1].number, said[1].reason, said[1].measured_ms) == (1, "", (("video", 150.1),))
    assert said[1].problems.startswith("its jitter has stopped; ")
    assert "NTP: no packet came through" in said[1].problems
    assert said[2] == InjectionResult(2, "", "", ())
    both = ((VIDEO,), (PROBE,))
    assert queues.did == [("L2", *both), ("verify", *both, 10), ("measure", *both, 10), "clear", "clear"]


def test_a_failure_is_told_and_the_next_order_is_done() -> None:
    """What the queues cannot do is told, in their words where they have any, and does not end the side."""
    queues = NamedQueues(UserError("there is no tc"))
    assert ordered(queues, InjectionOrder(1, "L2", (VIDEO,))) == [InjectionResult(1, "there is no tc", "", ())]
    broken = NamedQueues(OSError("the interface went down"))
    said = ordered(broken, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "", ()))
    assert said == [InjectionResult(1, "OSError: the interface went down", "", ()), InjectionResult(2, "", "", ())]
    assert broken.did == ["clear", "clear"]


def test_a_condition_that_is_not_as_requested_when_it_is_applied_is_not_in_force() -> None:
    """Where verifying finds otherwise than asked, the order has failed, with what was found."""
    assert ordered(NamedQueues(problems=("video was late", "no filter")), InjectionOrder(1, "L2", (VIDEO,))) == [
        InjectionResult(1, "video was late; no filter", "", ())
    ]


def test_of_orders_that_wait_only_the_last_is_done() -> None:
    """Of the orders that come while one is carried out only the last counts: a flood of orders is no flood of work."""
    queues = NamedQueues()
    queues.go.clear()
    told = Told(queues)
    told.injector.send(Send("inject", InjectionOrder(1, "L2", (VIDEO,))))
    assert queues.begun.wait(ANSWERS_S)
    for number in range(2, 100):
        told.injector.send(Send("inject", InjectionOrder(number, "L2", (VIDEO,))))
    told.injector.send(Send("inject", InjectionOrder(100, "", ())))
    queues.go.set()
    assert [told.said.get(timeout=ANSWERS_S).number for _ in range(2)] == [1, 100]
    told.injector.close()
    assert queues.did[-2:] == ["clear", "clear"]


def test_without_an_interface_only_nothing_can_be_ordered() -> None:
    """Where no interface is configured, a delay is refused with what to do, and none is granted."""
    said = ordered(None, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "L0", (NOTHING,)))
    assert said[0].reason == "no interface is configured for it: set injection.interface"
    assert said[1].reason == ""
