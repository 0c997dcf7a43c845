"""The injector: a thread that uses netem to apply and measure the impairments that the injection node orders."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from msgspec import Struct

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import LavtError
from lavt.node import Send
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow
from lavt.transport.netem.netem import Verification
from lavt.transport.netem.queue_probe import ProbeResult, judge

Deliver = Callable[[str, Any, Now, Any], None]

MEASURED_PACKETS = 10
"""How many test packets are sent to measure a flow; this takes a fifth of a second."""
NO_INTERFACE = "no interface is configured for it: set injection.interface"

log = logging.getLogger(__name__)


class InjectionOrder(Struct, frozen=True):
    """An order that puts the impairments of these flows in force, and ends the impairments of all other flows."""

    number: int
    condition: str
    flows: tuple[ImpairedFlow, ...]


class InjectionResult(Struct, frozen=True):
    """The result of an order."""

    number: int
    reason: str
    """Why the order is not in force; empty if it is."""
    problems: str
    """How the measurement differs from the order; empty if it does not."""
    measured_ms: tuple[tuple[str, float | None], ...]
    """The median delay of each flow."""


class NetemQueues(Protocol):
    """An interface to the queues that delay packets from this machine."""

    def apply(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], condition: str) -> object:
        """Apply flows, or change the flows in force; raises `LavtError`."""
        ...

    def verify(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int) -> Verification:
        """Read back what is in force, and measure `count` packets of each flow and of each exempt port."""
        ...

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int
    ) -> dict[str, ProbeResult]:
        """Measure `count` packets of each flow and of each exempt port, without reading back."""
        ...

    def problems(self) -> list[str]:
        """Return the differences from the order that are known without measuring."""
        ...

    def clear(self) -> object:
        """Restore the interface."""
        ...


class Injector:
    """A link that executes injection orders one after the other; without `queues` only transparent flows are possible.

    Orders for flows that cover a port of `exempt` fail.
    """

    def __init__(
        self, clock: Clock, deliver: Deliver, queues: NetemQueues | None, exempt: Sequence[ExemptPort] = ()
    ) -> None:
        self._clock = clock
        self._deliver = deliver
        self._queues = queues
        self._exempt = tuple(exempt)
        self._applied_number = 0
        """Number of the order in force; if the order is repeated, its flows are only measured."""
        self._orders: queue.Queue[InjectionOrder | None] = queue.Queue()
        self._thread = threading.Thread(target=self._process_orders, name="injector", daemon=True)
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Queue orders."""
        for send in sends:
            self._orders.put(send.payload)

    def close(self) -> None:
        """Stop the thread and restore the interface."""
        self._orders.put(None)
        self._thread.join()
        if self._queues is not None:
            try:
                self._queues.clear()
            except LavtError as error:
                log.error("could not remove the injected delay: %s", error)

    def _process_orders(self) -> None:
        while (order := self._wait_for_newest()) is not None:
            try:
                result = self._execute(order)
            except Exception as error:  # whatever fails, later orders must be executed, such as a clearing
                log.exception("netem failed")
                result = InjectionResult(order.number, f"{type(error).__name__}: {error}", "", ())
            self._deliver("injected", result, self._clock.now(), None)

    def _wait_for_newest(self) -> InjectionOrder | None:
        """Wait for an order and return the newest one in the queue; None ends the thread."""
        order = self._orders.get()
        while order is not None and not self._orders.empty():
            order = self._orders.get()
        return order

    def _execute(self, order: InjectionOrder) -> InjectionResult:
        flows = order.flows
        if self._queues is None:
            return InjectionResult(
                order.number, "" if all(flow.impairment.is_transparent for flow in flows) else NO_INTERFACE, "", ()
            )
        try:
            if not flows:
                self._queues.clear()
                return InjectionResult(order.number, "", "", ())
            if order.number != self._applied_number:
                self._queues.apply(flows, exempt=self._exempt, condition=order.condition)
                verification = self._queues.verify(flows, exempt=self._exempt, count=MEASURED_PACKETS)
                if verification.reasons:
                    return InjectionResult(order.number, "; ".join(verification.reasons), "", ())
            else:  # a repeated order: the car can be driving, and starting a program would delay it
                measured = self._queues.measure(flows, exempt=self._exempt, count=MEASURED_PACKETS)
                verification = Verification(self._queues.problems() + judge(flows, self._exempt, measured), measured)
            self._applied_number = order.number
        except LavtError as error:
            return InjectionResult(order.number, str(error), "", ())
        measured_ms = tuple((flow.name, verification.measured[flow.name].median_ms) for flow in flows)
        return InjectionResult(order.number, "", "; ".join(verification.reasons), measured_ms)
