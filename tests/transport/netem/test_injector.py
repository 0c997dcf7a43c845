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
from lavt.transport.netem.queue_probe import ProbeResult

VIDEO = ImpairedFlow("video", "udp", 5600, "source", Impairment(150.0))
UNIMPAIRED = ImpairedFlow("video", "udp", 5600, "source", Impairment())
PROBE = ExemptPort("udp", 5602, "the clock probe")
MEASURED = {"video": ProbeResult(sent=10, lost=0, reordered=0, early=0, p5_ms=150.0, median_ms=150.1, p95_ms=150.2)}
TIMEOUT_S = 10.0


class FakeQueues:
    """A fake for the kernel's queues; `tests/kernel` tests the real ones."""

    def __init__(self, failure: Exception | None = None, problems: tuple[str, ...] = ()) -> None:
        self.calls: list[Any] = []
        self.apply_called, self.apply_allowed = threading.Event(), threading.Event()
        self.apply_allowed.set()
        self._failure = failure
        self._problems = problems

    def apply(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], condition: str) -> None:
        """Record the call when the test allows it, or fail."""
        self.apply_called.set()
        self.apply_allowed.wait(TIMEOUT_S)
        if self._failure:
            raise self._failure
        self.calls.append((condition, tuple(flows), tuple(exempt)))

    def verify(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int) -> Verification:
        """Record the call and return fixed measurements."""
        self.calls.append(("verify", tuple(flows), tuple(exempt), count))
        return Verification(list(self._problems), MEASURED)

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int
    ) -> dict[str, ProbeResult]:
        """Record the call and return the same measurements."""
        self.calls.append(("measure", tuple(flows), tuple(exempt), count))
        return MEASURED

    def problems(self) -> list[str]:
        """Return one problem."""
        return ["its jitter has stopped"]

    def clear(self) -> None:
        """Record the call."""
        self.calls.append("clear")


class InjectorHarness:
    """An injector and its results."""

    def __init__(self, queues: FakeQueues | None) -> None:
        self.results: queue.Queue[InjectionResult] = queue.Queue()
        self.injector = Injector(MachineClock(), self._deliver, queues, [PROBE])

    def _deliver(self, _channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        self.results.put(payload)

    def order(self, order: InjectionOrder) -> InjectionResult:
        """Send an order and wait for its result."""
        self.injector.send(Send("inject", order))
        return self.results.get(timeout=TIMEOUT_S)


def execute(queues: FakeQueues | None, *orders: InjectionOrder) -> list[InjectionResult]:
    """Return an injector's results for orders sent one after the other; close the injector."""
    harness = InjectorHarness(queues)
    results = [harness.order(order) for order in orders]
    harness.injector.close()
    return results


def test_repeated_order_is_measured_only() -> None:
    """A repeated order is measured, but not applied again. An order without flows and closing clear the queues."""
    queues = FakeQueues()
    results = execute(
        queues, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "", ())
    )
    assert results[0] == InjectionResult(1, "", "", (("video", 150.1),))
    assert (results[1].number, results[1].reason, results[1].measured_ms) == (1, "", (("video", 150.1),))
    assert results[1].problems.startswith("its jitter has stopped; ")
    assert "NTP: no packet came through" in results[1].problems
    assert results[2] == InjectionResult(2, "", "", ())
    flows_and_exempt = ((VIDEO,), (PROBE,))
    assert queues.calls == [
        ("L2", *flows_and_exempt),
        ("verify", *flows_and_exempt, 10),
        ("measure", *flows_and_exempt, 10),
        "clear",
        "clear",
    ]


def test_failure_is_reported_and_the_next_order_executed() -> None:
    """A failed order's result has the message of the exception, and the next order is executed."""
    queues = FakeQueues(UserError("there is no tc"))
    assert execute(queues, InjectionOrder(1, "L2", (VIDEO,))) == [InjectionResult(1, "there is no tc", "", ())]
    broken = FakeQueues(OSError("the interface went down"))
    results = execute(broken, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "", ()))
    assert results == [InjectionResult(1, "OSError: the interface went down", "", ()), InjectionResult(2, "", "", ())]
    assert broken.calls == ["clear", "clear"]


def test_failed_verification_fails_the_order() -> None:
    """An order fails if its verification finds differences, and its result lists them."""
    assert execute(FakeQueues(problems=("video was late", "no filter")), InjectionOrder(1, "L2", (VIDEO,))) == [
        InjectionResult(1, "video was late; no filter", "", ())
    ]


def test_only_the_newest_queued_order_is_executed() -> None:
    """Of the orders that arrive while an order is executed, only the newest is executed next."""
    queues = FakeQueues()
    queues.apply_allowed.clear()
    harness = InjectorHarness(queues)
    harness.injector.send(Send("inject", InjectionOrder(1, "L2", (VIDEO,))))
    assert queues.apply_called.wait(TIMEOUT_S)
    for number in range(2, 100):
        harness.injector.send(Send("inject", InjectionOrder(number, "L2", (VIDEO,))))
    harness.injector.send(Send("inject", InjectionOrder(100, "", ())))
    queues.apply_allowed.set()
    assert [harness.results.get(timeout=TIMEOUT_S).number for _ in range(2)] == [1, 100]
    harness.injector.close()
    assert queues.calls[-2:] == ["clear", "clear"]


def test_without_an_interface_only_zero_delay_is_accepted() -> None:
    """Without a configured interface a delay is rejected, and zero delay is accepted."""
    results = execute(None, InjectionOrder(1, "L2", (VIDEO,)), InjectionOrder(2, "L0", (UNIMPAIRED,)))
    assert "injection.interface" in results[0].reason
    assert results[1].reason == ""
