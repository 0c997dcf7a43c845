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
from lavt.transport.netem import Flow
from lavt.value import value

Deliver = Callable[[str, Any, Now, Any], None]

log = logging.getLogger(__name__)


@value
class Inject:
    """What shall be in force from now on; no flows: nothing."""

    number: int
    condition: str
    flows: tuple[Flow, ...]


@value
class Injected:
    """What became of an order: empty `because`, and it is in force; and for each flow the median that was measured."""

    number: int
    because: str
    measured_ms: tuple[tuple[str, float | None], ...]


class Queues(Protocol):
    """What can delay what this machine sends."""

    def apply(self, flows: Sequence[Flow], condition: str) -> None:
        """Put flows in force, or change them; raises `LavtError`."""
        ...

    def measure_ms(self) -> dict[str, float | None]:
        """Tell the median delay of each flow."""
        ...

    def clear(self) -> None:
        """Put everything back."""
        ...


class Injector:
    """Does one order after the other, where there are `queues`; without them only having none can be ordered."""

    def __init__(self, clock: Clock, deliver: Deliver, queues: Queues | None) -> None:
        self._clock = clock
        self._deliver = deliver
        self._queues = queues
        self._orders: queue.Queue[Inject | None] = queue.Queue()
        self._thread = threading.Thread(target=self._work, name="injector", daemon=True)
        self._thread.start()

    def send(self, send: Send) -> None:
        """Take an order."""
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
        while (order := self._orders.get()) is not None:
            because, measured = self._do(order)
            self._deliver("injected", Injected(order.number, because, measured), self._clock.now(), None)

    def _do(self, order: Inject) -> tuple[str, tuple[tuple[str, float | None], ...]]:
        if self._queues is None:
            return ("no interface is configured for it: set injection.interface" if order.flows else ""), ()
        try:
            if not order.flows:
                self._queues.clear()
                return "", ()
            self._queues.apply(order.flows, order.condition)
            return "", tuple(self._queues.measure_ms().items())
        except LavtError as error:
            return str(error), ()
