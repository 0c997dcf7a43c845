"""This machine's own queues as a link: carries out what the injection node wants, in a thread, and measures it."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import LavtError
from lavt.node import Send
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow
from lavt.transport.netem.netem import Verification
from lavt.transport.netem.probe import ProbeResult, judge
from lavt.value import value

Deliver = Callable[[str, Any, Now, Any], None]

FRAMES = 10
"""So many measure a flow, in a fifth of a second."""
NO_INTERFACE = "no interface is configured for it: set injection.interface"

log = logging.getLogger(__name__)


@value
class InjectionOrder:
    """What shall be in force from now on; no flows: nothing."""

    number: int
    condition: str
    flows: tuple[ImpairedFlow, ...]


@value
class InjectionResult:
    """What became of an order."""

    number: int
    reason: str
    """Why it is not in force; empty: it is."""
    problems: str
    """What was measured to be otherwise than asked."""
    measured_ms: tuple[tuple[str, float | None], ...]
    """The median of each flow."""


class NetemQueues(Protocol):
    """What can delay what this machine sends."""

    def apply(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], condition: str) -> object:
        """Put flows in force, or change them; raises `LavtError`."""
        ...

    def verify(self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int) -> Verification:
        """Read back what is in force, and measure what happens to packets of flows, and of what must not be held."""
        ...

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort], count: int
    ) -> dict[str, ProbeResult]:
        """Measure the same, and read nothing back."""
        ...

    def problems(self) -> list[str]:
        """Tell what is known to be otherwise than asked without measuring."""
        ...

    def clear(self) -> object:
        """Put everything back."""
        ...


class Injector:
    """Does one order after the other, where there are `queues`; without them only no delay can be ordered.

    `exempt` are ports that no order may cover.
    """

    def __init__(
        self, clock: Clock, deliver: Deliver, queues: NetemQueues | None, exempt: Sequence[ExemptPort] = ()
    ) -> None:
        self._clock = clock
        self._deliver = deliver
        self._queues = queues
        self._exempt = tuple(exempt)
        self._applied = 0
        """Number of the order in force: one that comes again is only measured."""
        self._orders: queue.Queue[InjectionOrder | None] = queue.Queue()
        self._thread = threading.Thread(target=self._work, name="injector", daemon=True)
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Take orders."""
        for send in sends:
            self._orders.put(send.payload)

    def close(self) -> None:
        """Put everything back."""
        self._orders.put(None)
        self._thread.join()
        if self._queues is not None:
            try:
                self._queues.clear()
            except LavtError as error:
                log.error("the delay could not be taken away: %s", error)

    def _work(self) -> None:
        while (order := self._newest()) is not None:
            try:
                done = self._do(order)
            except Exception as error:  # whatever it was, the next order, which may be to put all back, must be done
                log.exception("netem failed")
                done = InjectionResult(order.number, f"{type(error).__name__}: {error}", "", ())
            self._deliver("injected", done, self._clock.now(), None)

    def _newest(self) -> InjectionOrder | None:
        """Wait for an order; of several that wait only the last counts, and after None nothing does."""
        order = self._orders.get()
        while order is not None and not self._orders.empty():
            order = self._orders.get()
        return order

    def _do(self, order: InjectionOrder) -> InjectionResult:
        flows = order.flows
        if self._queues is None:
            return InjectionResult(
                order.number, "" if all(flow.impairment.is_transparent for flow in flows) else NO_INTERFACE, "", ()
            )
        try:
            if not flows:
                self._queues.clear()
                return InjectionResult(order.number, "", "", ())
            if order.number != self._applied:
                self._queues.apply(flows, exempt=self._exempt, condition=order.condition)
                found = self._queues.verify(flows, exempt=self._exempt, count=FRAMES)
                if found.reasons:
                    return InjectionResult(order.number, "; ".join(found.reasons), "", ())
            else:  # while it is driven: without starting programs, which would hold it up
                measured = self._queues.measure(flows, exempt=self._exempt, count=FRAMES)
                found = Verification(self._queues.problems() + judge(flows, self._exempt, measured), measured)
            self._applied = order.number
        except LavtError as error:
            return InjectionResult(order.number, str(error), "", ())
        measured_ms = tuple((flow.name, found.measured[flow.name].median_ms) for flow in flows)
        return InjectionResult(order.number, "", "; ".join(found.reasons), measured_ms)
