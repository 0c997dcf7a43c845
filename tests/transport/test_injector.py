from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import Any

from lavt.clock import MachineClock
from lavt.domain import Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.transport.injector import Inject, Injected, Injector
from lavt.transport.netem import Flow, Law, Port
from lavt.transport.netem_control import Verified
from lavt.transport.netem_probe import Measured

VIDEO = Flow("video", "udp", 5600, "source", Law(150.0))
NOTHING = Flow("video", "udp", 5600, "source", Law())
PROBE = Port("udp", 5602, "the clock probe")


class NamedQueues:
    """A stand-in for the kernel's queues, which have a test of their own in `tests/kernel`."""

    def __init__(self, failure: str = "") -> None:
        self.did: list[Any] = []
        self._failure = failure

    def apply(self, flows: Sequence[Flow], *, never: Sequence[Port], condition: str) -> None:
        """Note it, or fail."""
        if self._failure:
            raise UserError(self._failure)
        self.did.append((condition, tuple(flows), tuple(never)))

    def verify(self, flows: Sequence[Flow], *, never: Sequence[Port], count: int) -> Verified:
        """Give what is always found, beside what is asked about."""
        self.did.append(("verify", tuple(flows), tuple(never)))
        return Verified(["read back otherwise"], {"video": Measured(count, 0, 0, 0, 150.0, 150.1, 150.2)})

    def measure(self, flows: Sequence[Flow], *, never: Sequence[Port], count: int) -> dict[str, Measured]:
        """Give the same."""
        self.did.append(("measure", tuple(flows), tuple(never)))
        return {"video": Measured(count, 0, 0, 0, 150.0, 150.1, 150.2)}

    def clear(self) -> None:
        """Note it."""
        self.did.append("clear")


def ordered(queues: NamedQueues | None, *orders: Inject) -> list[Injected]:
    """Give what an injector says of each order, having been closed."""
    said: queue.Queue[Injected] = queue.Queue()

    def deliver(_channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        said.put(payload)

    injector = Injector(MachineClock(), deliver, queues, [PROBE])
    for order in orders:
        injector.send(Send("inject", order))
    injector.close()
    return [said.get_nowait() for _ in orders]


def test_orders_are_done_in_order_measured_and_put_back_at_the_end() -> None:
    """An order is applied once and measured whenever it comes; one without flows clears, and closing puts all back."""
    queues = NamedQueues()
    said = ordered(queues, Inject(1, "L2", (VIDEO,)), Inject(1, "L2", (VIDEO,)), Inject(2, "", ()))
    assert said[0] == Injected(1, "", "read back otherwise", (("video", 150.1),))
    assert (said[1].number, said[1].because, said[1].measured_ms) == (1, "", (("video", 150.1),))
    assert "NTP: no packet came through" in said[1].doubts
    assert said[2] == Injected(2, "", "", ())
    both = ((VIDEO,), (PROBE,))
    assert queues.did == [("L2", *both), ("verify", *both), ("measure", *both), "clear", "clear"]


def test_a_failure_is_told() -> None:
    """What the queues cannot do is told in their words, and does not end the side."""
    assert ordered(NamedQueues("there is no tc"), Inject(1, "L2", (VIDEO,))) == [Injected(1, "there is no tc", "", ())]


def test_without_an_interface_only_nothing_can_be_ordered() -> None:
    """Where no interface is configured, a delay is refused with what to do, and none is granted."""
    said = ordered(None, Inject(1, "L2", (VIDEO,)), Inject(2, "L0", (NOTHING,)))
    assert said[0].because == "no interface is configured for it: set injection.interface"
    assert said[1].because == ""
